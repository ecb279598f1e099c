"""Joint by joint, without inverse kinematics, where a skeleton is the character's own.

    copied = copy_joints(motion, rig, figure)                 # None where they do not agree
    copied.qpos, copied.places["left_foot"]                   # (T, nq), (T, 3) m

They agree when every body of the character has a joint of the skeleton (of its name, or by its part), in the same tree,
with the same bones up to one scale, and when hinges see turns about their axes alone. Bones are compared in two zero
poses: the one in which the character's own body frames are unturned, and its reference pose (qpos0). AMP's and
poselib's files are of the first kind for the built-in humanoid, exported BVH of the second. Feet are as they were
recorded: put on the floor (motion/ground.py), not pinned to it.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.ground import floor_height
from kinetok.motion.kinematics import joint_anchors
from kinetok.motion.retarget.body import Figure
from kinetok.motion.retarget.solve import hinge_angle, within_limits, wrapped
from kinetok.motion.rigs import Rig
from kinetok.motion.skeleton import SkeletonMotion

BONES = 0.005  # m that a bone's end may be elsewhere
ASIDE = 0.05  # rad that a hinge may be turned about other axes
HINGE, BALL = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL


@dataclass(frozen=True, kw_only=True)
class Copied:
    """qpos (T, nq); places: part -> (T, 3) m, where the skeleton has its joint centre, at the character's size and on
    its floor; scale: character's bones / skeleton's."""

    qpos: np.ndarray
    places: dict[str, np.ndarray]
    scale: float


def copy_joints(motion: SkeletonMotion, rig: Rig, figure: Figure) -> Copied | None:
    """The motion's own joint angles on the figure's character, or None where the two are not built alike."""
    character = figure.character
    joints = _counterparts(motion, rig, character)
    frames = joints and _zero_frames(motion, joints, character)
    if not joints or not frames:
        return None
    zero, scale = frames
    points, turns = motion.pose()
    turns = rotation.multiply(turns[:, joints], np.broadcast_to(zero, turns[:, joints].shape))
    qpos = _angles(turns, character)
    if qpos is None:
        return None
    anchors = joint_anchors(character)
    origins = scale * points[:, joints] - rotation.rotate(turns, np.broadcast_to(anchors, points[:, joints].shape))
    qpos[:, :3] = origins[:, 0]
    qpos = within_limits(character.model, qpos)
    down = floor_height(character, qpos, motion.fps)
    qpos[:, 2] -= down
    origins[..., 2] -= down[:, None]
    places = {
        part: origins[:, at] + rotation.rotate(turns[:, at], np.broadcast_to(figure.centre[part], origins[:, at].shape))
        for part, at in figure.bodies.items()
    }
    return Copied(qpos=qpos, places=places, scale=scale)


def _counterparts(motion: SkeletonMotion, rig: Rig, character: Character) -> list[int]:
    """The joint of each body (B,), in the same tree; empty where one is missing or hangs elsewhere."""
    part_of = {index: part for part, index in character.parts.items()}
    joints = []
    for body, name in enumerate(character.body_names):
        if name in motion.joints:
            joints.append(motion.joints.index(name))
        elif part_of.get(body) in rig.parts:
            joints.append(rig.parts[part_of[body]])
        else:
            return []
    above = [joints[parent] if parent >= 0 else -1 for parent in character.parents]
    hang_alike = all(motion.parents[joint] == parent for joint, parent in zip(joints, above, strict=True))
    return joints if hang_alike and len(set(joints)) == len(joints) else []


def _zero_frames(motion: SkeletonMotion, joints: list[int], character: Character) -> tuple[np.ndarray, float] | None:
    """K (B, 4), the body's orientation when its joint's world rotation is none, and the scale; None where bones of
    neither zero pose are alike."""
    model, data = character.model, mujoco.MjData(character.model)
    mujoco.mj_kinematics(model, data)
    anchors, parents = joint_anchors(character), np.array(character.parents[1:])
    bones = model.body_pos[2:] + rotation.rotate(model.body_quat[2:], anchors[1:]) - anchors[parents]
    theirs = motion.offsets[joints][1:]
    scale = float(np.linalg.norm(bones, axis=-1).sum() / max(np.linalg.norm(theirs, axis=-1).sum(), 1e-9))
    plain = np.tile([1.0, 0, 0, 0], (len(joints), 1))
    for zero in (plain, data.xquat[1:].copy()):
        ours = rotation.rotate(zero[parents], bones)
        if np.linalg.norm(scale * theirs - ours, axis=-1).max() < BONES:
            return zero, scale
    return None


def _angles(turns: np.ndarray, character: Character) -> np.ndarray | None:
    """Poses (T, nq) in which the bodies have the orientations (T, B, 4); None where their joints do not allow that."""
    model = character.model
    qpos = np.tile(model.qpos0, (len(turns), 1))
    qpos[:, 3:7] = rotation.align(turns[:, 0])
    leaves = set(range(len(character.parents))) - set(character.parents)
    for body, parent in enumerate(character.parents[1:], start=1):
        carried = rotation.multiply(turns[:, parent], np.broadcast_to(model.body_quat[body + 1], turns[:, 0].shape))
        turn = rotation.multiply(rotation.conjugate(carried), turns[:, body])
        first, count = model.body_jntadr[body + 1], model.body_jntnum[body + 1]
        if count == 0 and body in leaves:
            continue
        kind = model.jnt_type[first] if count == 1 else None
        if kind == BALL:
            at = model.jnt_qposadr[first]
            qpos[:, at : at + 4] = rotation.align(turn)
            continue
        axis = model.jnt_axis[first] if kind == HINGE else np.zeros(3)
        angle = hinge_angle(turn, axis)
        rest = rotation.multiply(turn, rotation.from_rotvec(-angle[:, None] * axis))
        if count > 1 or np.linalg.norm(rotation.to_rotvec(rest), axis=-1).max() > ASIDE:
            return None
        if kind == HINGE:
            at = model.jnt_qposadr[first]
            qpos[:, at] = wrapped(angle + model.qpos0[at])
    return qpos
