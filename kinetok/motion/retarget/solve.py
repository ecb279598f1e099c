"""Inverse kinematics of a plan by mink: one small quadratic program per iteration, joint limits as constraints.

    qpos = solve(figure, plan, fps=30)                        # (T, nq)

Each frame starts from the plan itself where a part hangs on a single joint, whose angle the orientations of two parts
give in closed form, and from the frame before elsewhere (several hinges in a row). A character whose every part
hangs on one ball or hinge is then solved but for joint limits. Feet weigh most, then pelvis, hands and knees;
orientations of the limbs settle what positions leave open. Needs the optional extra: pip install 'kinetok[retarget]'.
"""

import mujoco
import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import quaternion_columns
from kinetok.motion.kinematics import lowest_point
from kinetok.motion.retarget.body import ABOVE, Figure
from kinetok.motion.retarget.source import LIMBS, SIDES
from kinetok.motion.retarget.targets import Plan, envelope

# position per metre, orientation per radian
COSTS = {
    "pelvis": (5.0, 2.0),
    "chest": (0.0, 1.0),
    "head": (0.0, 0.5),
    "thigh": (0.0, 0.2),
    "shin": (1.0, 0.2),
    "foot": (20.0, 2.0),
    "upper_arm": (0.0, 0.2),
    "lower_arm": (2.0, 0.2),
    "hand": (2.0, 0.2),
}
TOE_OUT = 0.7  # of a foot about its own vertical: ankles of robots do not turn that way, their hips would have to
POSTURE, DAMPING = 1e-3, 1e-4
AFRESH, EACH, DONE = 20, 6, 1e-4  # most iterations from rest and from the frame before; rad, the step that ends them
LOST = 0.04  # m: a limb whose end is farther than this from its target is tried from rest as well
FASTEST = 25.0  # rad/s of a hinge: hinges in a row would flip where their axes align


def solve(figure: Figure, plan: Plan, fps: float) -> np.ndarray:
    """Poses (T, nq) of the character that follow the plan, at fps frames per second."""
    body, model = figure.character, figure.character.model
    guess, known, turns = closed_form(figure, plan)
    descent = Descent(figure, plan, turns)
    guess[:, :3] = descent.origins["pelvis"]
    reach = np.full(model.nq, np.inf)
    reach[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]] = FASTEST / fps
    qpos = np.empty_like(guess)
    descent.aim(0)
    qpos[0], _ = descent.run(guess[0], AFRESH)
    for t in range(1, len(guess)):
        descent.aim(t)
        last, turned = qpos[t - 1], False
        pose, far = descent.run(np.where(known, guess[t], last), EACH)
        lost = far.max() > LOST
        if lost and not known.all():
            columns = np.any(
                [limb for limb, off in zip(descent.limbs.values(), far, strict=True) if off > LOST], axis=0
            )
            other, better = descent.run(np.where(columns, guess[t], pose), AFRESH)
            turned = bool(better.max() < far.max() / 2)
            pose = other if turned else pose
        if (np.abs(pose - last) > reach).any():
            pose = np.clip(pose, last - reach, last + reach)
            # on the way to another solution the targets would only pull back
            pose = pose if turned else descent.run(pose, EACH, (last - reach, last + reach))[0]
        qpos[t] = pose
    qpos = within_limits(model, qpos)
    columns = quaternion_columns(body)[:, None] + np.arange(4)
    qpos[:, columns] = rotation.align(rotation.normalize(qpos[:, columns]))
    return qpos


class Descent:
    """The quadratic programs of one plan. origins: part -> (T, 3), where bodies should be; limbs: see limb_columns."""

    def __init__(self, figure: Figure, plan: Plan, turns: dict[str, np.ndarray]):
        try:
            import daqp  # noqa: F401
            import mink
        except ImportError as error:
            raise ImportError(
                f"retargeting needs {error.name}, which is not installed: pip install 'kinetok[retarget]'"
            ) from error
        model = figure.character.model
        self.mink, self.turns, self.limbs = mink, turns, limb_columns(figure)
        self.origins = {
            part: place - rotation.rotate(turns[part], np.broadcast_to(figure.centre[part], place.shape))
            for part, place in plan.places.items()
        }
        self.tasks = {}
        for part in turns:
            place, turn = COSTS[part.removeprefix("left_").removeprefix("right_")]
            if part.endswith("foot"):
                turn = turn - (turn - TOE_OUT) * figure.frame[part][:, 2] ** 2
            name = figure.character.body_names[figure.bodies[part]]
            self.tasks[part] = mink.FrameTask(name, "body", place, turn)
        posture = mink.PostureTask(model, POSTURE)
        posture.set_target(model.qpos0)
        self.all = [*self.tasks.values(), posture]
        self.limits = [mink.ConfigurationLimit(model)]
        self.configuration = mink.Configuration(model)

    def aim(self, t: int) -> None:
        """Take the targets of frame t."""
        for part, task in self.tasks.items():
            where = self.origins[part][t] if part in self.origins else np.zeros(3)
            task.set_target(self.mink.SE3(np.concatenate([self.turns[part][t], where])))

    def run(
        self, start: np.ndarray, iterations: int, bounds: tuple[np.ndarray, np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The pose (nq,) that iterations from `start` reach within bounds, and how far the ends of the limbs are from
        their targets, metres."""
        configuration = self.configuration
        configuration.update(start)
        for _ in range(iterations):
            step = self.mink.solve_ik(configuration, self.all, 1.0, "daqp", DAMPING, limits=self.limits)
            configuration.integrate_inplace(step, 1.0)
            if bounds is not None:
                configuration.update(np.clip(configuration.q, *bounds))
            if np.abs(step).max() < DONE:
                break
        far = [np.linalg.norm(self.tasks[end].compute_error(configuration)[:3]) for end in self.limbs]
        return configuration.q.copy(), np.array(far)


def clear_floor(body: Character, qpos: np.ndarray, fps: float) -> np.ndarray:
    """Poses (T, nq) raised, smoothly in time, where hands, knees, back or whatever else would be below z = 0."""
    qpos = qpos.copy()
    qpos[:, 2] += envelope(np.maximum(-lowest_point(body, qpos), 0), fps)
    return qpos


def within_limits(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Poses (T, nq) with hinges clipped to their ranges and balls turned back to their largest angle."""
    qpos = qpos.copy()
    for joint in np.flatnonzero(model.jnt_limited):
        at, (low, high) = model.jnt_qposadr[joint], model.jnt_range[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            qpos[:, at : at + 4] = _shorten(qpos[:, at : at + 4], high)
        else:
            qpos[:, at] = np.clip(qpos[:, at], low, high)
    return qpos


def _shorten(turn: np.ndarray, largest: float) -> np.ndarray:
    """Rotations (T, 4) about the same axes by no more than `largest` radians."""
    vector = rotation.to_rotvec(turn)
    angle = np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)
    return rotation.from_rotvec(vector * np.minimum(1, largest / angle))


def closed_form(figure: Figure, plan: Plan) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Poses (T, nq) by the plan's orientations; which columns (nq,) they give, those of the root and of joints that
    alone connect two parts; and the orientations, part -> (T, 4), as far as the limits of those joints allow."""
    model, data = figure.character.model, mujoco.MjData(figure.character.model)
    mujoco.mj_kinematics(model, data)
    turns = dict(plan.turns)
    poses, known = np.tile(model.qpos0, (len(turns["pelvis"]), 1)), np.zeros(model.nq, dtype=bool)
    poses[:, 3:7], known[:7] = turns["pelvis"], True
    for part, above in ABOVE.items():
        if part not in turns:
            continue
        joints = joints_between(model, figure.bodies[above] + 1, figure.bodies[part] + 1)
        if len(joints) != 1 or model.jnt_type[joints[0]] == mujoco.mjtJoint.mjJNT_SLIDE:
            continue
        joint, end = joints[0], data.xquat[figure.bodies[part] + 1]
        carrier = data.xquat[model.jnt_bodyid[joint]]
        # R_part = R_above C Q D with the joint's rotation Q and constants C, D at rest
        c = rotation.multiply(rotation.conjugate(data.xquat[figure.bodies[above] + 1]), carrier)
        d = rotation.multiply(rotation.conjugate(carrier), end)
        base = rotation.multiply(turns[above], c)
        turn = rotation.multiply(rotation.conjugate(base), rotation.multiply(turns[part], rotation.conjugate(d)))
        at, (low, high) = model.jnt_qposadr[joint], model.jnt_range[joint]
        limited, axis = model.jnt_limited[joint], model.jnt_axis[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            turn = _shorten(turn, high) if limited else turn
            poses[:, at : at + 4], known[at : at + 4] = turn, True
        else:
            angle = wrapped(hinge_angle(turn, axis) + model.qpos0[at])
            poses[:, at], known[at] = np.clip(angle, low, high) if limited else angle, True
            turn = rotation.from_rotvec((poses[:, at] - model.qpos0[at])[:, None] * axis)
        turns[part] = rotation.multiply(rotation.multiply(base, turn), np.broadcast_to(d, turn.shape))
    return poses, known, turns


def hinge_angle(turn: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Angles (T,) about an axis (3,) that are nearest to rotations (T, 4)."""
    return 2 * np.arctan2(turn[:, 1:] @ axis, turn[:, 0])


def wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angles between -pi and pi."""
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def limb_columns(figure: Figure) -> dict[str, np.ndarray]:
    """Last part of each limb -> (nq,) bool, the columns of the joints from the trunk to it."""
    model, limbs = figure.character.model, {}
    for side in SIDES:
        for limb in LIMBS:
            above, end = ABOVE[f"{side}_{limb[0]}"], f"{side}_{limb[-1]}"
            joints = joints_between(model, figure.bodies[above] + 1, figure.bodies[end] + 1)
            ends = np.append(model.jnt_qposadr, model.nq)
            limbs[end] = np.zeros(model.nq, dtype=bool)
            for joint in joints:
                limbs[end][ends[joint] : ends[joint + 1]] = True
    return limbs


def joints_between(model: mujoco.MjModel, above: int, body: int) -> list[int]:
    """Joints of a body and of those over it up to, not including, the body `above`."""
    joints: list[int] = []
    while body not in (above, 0):
        first = model.body_jntadr[body]
        joints += range(first, first + model.body_jntnum[body])
        body = model.body_parentid[body]
    return joints
