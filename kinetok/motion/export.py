"""A character's motion as a plain skeleton, for programs that know joints and not MJCF.

    motion = skeleton_motion(Character.load("humanoid"), clip)
    write_bvh(Path("walk.bvh"), motion)

Every body is a joint, named after it and standing where the body's joint does. Joint frames are turned so that all
rotations are zero in the MJCF's reference pose (qpos0), as animation programs expect; a loop is one cycle.
Refused: a character whose bodies slide, for a skeleton's bones have a fixed length.
"""

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import kinematics
from kinetok.motion.skeleton import SkeletonMotion

TOLERANCE = 1e-6  # metres


def skeleton_motion(character: Character, clip: Clip) -> SkeletonMotion:
    """The clip as joints: T frames, one joint per body, metres, z up; family is the character's name."""
    if clip.qpos.shape[1] != character.nq:
        raise ValueError(f"clip {clip.name!r} has {clip.qpos.shape[1]} columns; {character.name!r} has {character.nq}")
    poses = kinematics(character, np.concatenate([character.model.qpos0[None], clip.qpos]), clip.fps)
    anchors = np.array([_anchor(character, body) for body in range(1, character.model.nbody)])
    points = poses.xpos + rotation.rotate(poses.xquat, anchors)
    turned = rotation.multiply(poses.xquat[1:], rotation.conjugate(poses.xquat[:1]))
    local, offsets = turned.copy(), np.zeros_like(anchors)
    for joint, parent in enumerate(character.parents):
        if parent < 0:
            continue
        up = rotation.conjugate(turned[:, parent])
        local[:, joint] = rotation.multiply(up, turned[:, joint])
        offsets[joint] = points[0, joint] - points[0, parent]
        bone = rotation.rotate(up, points[1:, joint] - points[1:, parent])
        moved = np.linalg.norm(bone - offsets[joint], axis=-1).max()
        if moved > TOLERANCE:
            raise ValueError(
                f"character {character.name!r}: body {character.body_names[joint]!r} moves by {moved:.3g} m against "
                "its parent; a skeleton's bones have a fixed length"
            )
    return SkeletonMotion(
        name=clip.name,
        fps=clip.fps,
        joints=character.body_names,
        parents=character.parents,
        offsets=offsets,
        local=rotation.align(local),
        root=points[1:, 0],
        family=character.name,
        source=clip.source,
    )


def _anchor(character: Character, body: int) -> np.ndarray:
    """Where the body's first joint is, in the body's frame; its origin where it has none."""
    first = character.model.body_jntadr[body]
    return character.model.jnt_pos[first] if first >= 0 else np.zeros(3)
