"""How well a retargeted motion follows its plan, touches the ground and keeps to the joints' limits.

report = assess(clip, motion, rig, actor, figure, scaled=plan.scaled, scale=plan.scale)
json.dumps(report.to_json())
"""

from dataclasses import asdict, dataclass

import mujoco
import numpy as np

from kinetok import rotation
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import kinematics, lowest_point
from kinetok.motion.retarget.body import Figure
from kinetok.motion.retarget.source import LIMBS, SIDES, Actor
from kinetok.motion.rigs import Rig
from kinetok.motion.skeleton import SkeletonMotion

KEY = ("pelvis", *(f"{side}_{part}" for side in SIDES for limb in LIMBS for part in limb[1:]))
TOLERANCE = 1e-3  # rad; a solver's rounding is no violation


@dataclass(frozen=True, kw_only=True)
class RetargetReport:
    """name; family, unit of the recording; rig: how its parts were told; calibration: "rest" or "motion"; frames, fps;
    scale: character's leg / actor's leg; residual_mean, residual_max: m, joint centres of pelvis, knees, ankles, elbows
    and wrists against their scaled targets; contact: share of frames in which a foot stands; skate: m/s, mean
    horizontal speed of the lowest point of standing feet; penetration_mean, penetration_max: m below the floor, of any
    body; violations, violation_max: joint angles beyond their limits and the largest excess, rad; speed_max: rad/s,
    fastest joint."""

    name: str
    family: str
    unit: str
    rig: str
    calibration: str
    frames: int
    fps: float
    scale: float
    residual_mean: float
    residual_max: float
    contact: float
    skate: float
    penetration_mean: float
    penetration_max: float
    violations: int
    violation_max: float
    speed_max: float

    def to_json(self) -> dict:
        """The fields as JSON-able values."""
        return asdict(self)


def assess(
    clip: Clip,
    motion: SkeletonMotion,
    rig: Rig,
    actor: Actor,
    figure: Figure,
    *,
    scaled: dict[str, np.ndarray],
    scale: float,
) -> RetargetReport:
    """Measure a clip of the figure's character. scaled: part -> (T, 3) m, where its joint centres should be."""
    body = figure.character
    moved = kinematics(body, clip.qpos, clip.fps)
    under = np.maximum(-lowest_point(body, clip.qpos), 0)
    excess = beyond_limits(body.model, clip.qpos)
    residuals = []
    for part in KEY:
        at = figure.bodies[part]
        centre = np.broadcast_to(figure.centre[part], (len(clip.qpos), 3))
        where = moved.xpos[:, at] + rotation.rotate(moved.xquat[:, at], centre)
        residuals.append(np.linalg.norm(where - scaled[part], axis=-1))
    return RetargetReport(
        name=clip.name,
        family=motion.family,
        unit=motion.unit,
        rig=rig.how,
        calibration=actor.calibration,
        frames=len(clip.qpos),
        fps=clip.fps,
        scale=scale,
        residual_mean=float(np.mean(residuals)),
        residual_max=float(np.max(residuals)),
        contact=float(np.mean(actor.contact["left"] | actor.contact["right"])),
        skate=skate(figure, moved.xpos, moved.xquat, actor),
        penetration_mean=float(under.mean()),
        penetration_max=float(under.max()),
        violations=int((excess > TOLERANCE).sum()),
        violation_max=float(excess.max(initial=0)),
        speed_max=float(np.abs(moved.qvel[:, 6:]).max()),
    )


def skate(figure: Figure, xpos: np.ndarray, xquat: np.ndarray, actor: Actor) -> float:
    """Mean horizontal speed (m/s) of the lowest point of a sole from one frame of contact to the next; where a level
    foot turns on the spot that is one of its corners."""
    speeds = []
    for side in SIDES:
        at, corners = figure.bodies[f"{side}_foot"], figure.soles[side]
        turns = rotation.to_matrix(xquat[:, at])
        points = xpos[:, None, at] + np.einsum("tij,kj->tki", turns, corners[:, :3])
        height = points[..., 2] - corners[:, 3]
        lowest = (height[1:] + height[:-1]).argmin(1)[:, None, None]
        step = np.take_along_axis(np.diff(points, axis=0), lowest, axis=1)[:, 0, :2]
        standing = actor.contact[side][1:] & actor.contact[side][:-1]
        speeds.append(np.linalg.norm(step[standing], axis=-1) * actor.fps)
    speeds = np.concatenate(speeds)
    return float(speeds.mean()) if len(speeds) else 0.0


def beyond_limits(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Excess (T, joints) in radians over the ranges of limited hinges and the largest angle of limited balls."""
    excess = np.zeros((len(qpos), model.njnt))
    for joint in np.flatnonzero(model.jnt_limited):
        at, (low, high) = model.jnt_qposadr[joint], model.jnt_range[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            excess[:, joint] = np.linalg.norm(rotation.to_rotvec(qpos[:, at : at + 4]), axis=-1) - high
        else:
            excess[:, joint] = np.maximum(qpos[:, at] - high, low - qpos[:, at])
    return np.maximum(excess, 0)
