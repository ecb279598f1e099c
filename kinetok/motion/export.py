"""A character's motion as a plain skeleton, for programs that know joints and not MJCF.

    motion = skeleton_motion(Character.load("humanoid"), clip)      # the character's own joints
    write_bvh(Path("walk.bvh"), motion)
    motion = smpl_motion(Character.load("humanoid"), clip)          # SMPL's joints
    write_amass(Path("walk.npz"), motion)

Its own skeleton: every body is a joint, named after it and standing where the body's joint does; joint frames are
turned so that all rotations are zero in the MJCF's reference pose (qpos0), as animation programs expect. Refused: a
character whose bodies slide, for a skeleton's bones have a fixed length.

SMPL's: the directions of thighs, shins and arms are the character's, and so are the turns about them, told by the axes
of knees and elbows, and the orientations of pelvis, chest, head, feet and hands. The lengths are those of the average
body of motion/smpl.py; the path is scaled by the ratio of the legs and raised so that a level sole stays where it
is. Spine and neck share the bend between their ends; collars go with the chest, toes with the feet, and the head with
the chest where the character has none. Refused: a character that does not name its parts.

A loop is one cycle.
"""

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import joint_anchors, kinematics
from kinetok.motion.retarget.body import Figure, measure
from kinetok.motion.retarget.source import LIMBS, SIDES, frame, to_quaternions, upright
from kinetok.motion.rigs import RIGS
from kinetok.motion.skeleton import SkeletonMotion
from kinetok.motion.smpl import JOINTS, OFFSETS, PARENTS

TOLERANCE = 1e-6  # metres
ANKLE = 0.08  # metres: of an adult with the offsets of motion/smpl.py, standing; ours, like them
AHEAD, LEFT, UP = np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.array([0.0, 1, 0])  # of SMPL's T-pose


def skeleton_motion(character: Character, clip: Clip) -> SkeletonMotion:
    """The clip as joints: T frames, one joint per body, metres, z up; family is the character's name."""
    _check_columns(character, clip)
    poses = kinematics(character, np.concatenate([character.model.qpos0[None], clip.qpos]), clip.fps)
    anchors = joint_anchors(character)
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


def smpl_motion(character: Character, clip: Clip) -> SkeletonMotion:
    """The clip as SMPL's 22 joints in the proportions of motion/smpl.py: T frames, metres, z up.

    Joint rotation in the world = (frame of the part now) (frame of SMPL's part in the T-pose)^-1, with the frames of
    retarget/source.py: along the bone and the axis of flexion for limbs; ahead, left and up for the others.
    """
    _check_columns(character, clip)
    figure = measure(character)
    places, frames = _posed(figure, clip)
    at_rest = _smpl_frames()
    turns = {part: to_quaternions(frames[part] @ at_rest[part].T) for part in frames}
    world = {joint: turns[part] for part, joint in RIGS["smpl"].items() if part in turns}
    pelvis, chest = turns["pelvis"], turns["chest"]
    third = np.full(len(chest), 1 / 3)
    world |= {"spine1": rotation.slerp(pelvis, chest, third), "spine2": rotation.slerp(pelvis, chest, 2 * third)}
    world |= {"spine3": chest, "left_collar": chest, "right_collar": chest, "head": world.get("head", chest)}
    world["neck"] = rotation.slerp(chest, world["head"], third * 1.5)
    world |= {f"{side}_foot": world[f"{side}_ankle"] for side in SIDES}
    turned = np.stack([world[joint] for joint in JOINTS], axis=1)
    above = rotation.conjugate(turned[:, PARENTS[1:]])
    local = np.concatenate([turned[:, :1], rotation.multiply(above, turned[:, 1:])], axis=1)
    scale = _leg(_smpl_lengths()) / _leg(figure.length)
    hips = (places["left_thigh"] + places["right_thigh"]) / 2
    hips_at_rest = (_offset("left_thigh") + _offset("right_thigh")) / 2
    root = scale * hips - rotation.rotate(pelvis, hips_at_rest)
    root[:, 2] += ANKLE - scale * _ankle_height(figure)
    return SkeletonMotion(
        name=clip.name,
        fps=clip.fps,
        joints=JOINTS,
        parents=PARENTS,
        offsets=OFFSETS,
        local=rotation.align(rotation.normalize(local)),
        root=root,
        family="smpl",
        source=clip.source,
    )


def _check_columns(character: Character, clip: Clip) -> None:
    if clip.qpos.shape[1] != character.nq:
        raise ValueError(f"clip {clip.name!r} has {clip.qpos.shape[1]} columns; {character.name!r} has {character.nq}")


def _posed(figure: Figure, clip: Clip) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Joint centres (T, 3) and frames (T, 3, 3) of a character's parts; those of limbs point from centre to centre."""
    moved = kinematics(figure.character, clip.qpos, clip.fps)
    places, frames = {}, {}
    for part, at in figure.bodies.items():
        turn = moved.xquat[:, at]
        places[part] = moved.xpos[:, at] + rotation.rotate(turn, figure.centre[part])
        frames[part] = rotation.to_matrix(turn) @ figure.frame[part]
    for upper, lower in _bones():
        frames[upper] = frame(places[lower] - places[upper], frames[upper][..., 1])
    return places, frames


def _smpl_frames() -> dict[str, np.ndarray]:
    """Frames (3, 3) of the parts in SMPL's T-pose: knees flex about the left axis, elbows from the side to ahead."""
    frames = {part: upright(LEFT, UP) for part in RIGS["smpl"]} | {"chest": upright(LEFT, UP)}
    for upper, lower in _bones():
        bone = _offset(lower)
        flexion = np.cross(bone, AHEAD) if "arm" in upper else LEFT
        frames[upper] = frame(bone, flexion)
        if lower.endswith("hand"):
            frames[lower] = frames[upper]  # as in retarget/body.py
    return frames


def _smpl_lengths() -> dict[str, float]:
    return {upper: float(np.linalg.norm(_offset(lower))) for upper, lower in _bones()}


def _offset(part: str) -> np.ndarray:
    """SMPL's offset (3,) of the joint at a part's upper end."""
    return OFFSETS[JOINTS.index(RIGS["smpl"][part])]


def _bones() -> list[tuple[str, str]]:
    """Parts of the limbs, each with the next."""
    pairs = [pair for limb in LIMBS for pair in zip(limb, limb[1:], strict=False)]
    return [(f"{side}_{upper}", f"{side}_{lower}") for side in SIDES for upper, lower in pairs]


def _leg(length: dict[str, float]) -> float:
    return sum(length[f"{side}_{part}"] for side in SIDES for part in ("thigh", "shin")) / 2


def _ankle_height(figure: Figure) -> float:
    """Height of the ankles' centres above the soles of level feet, the mean of both."""
    heights = []
    for side in SIDES:
        part, sole = f"{side}_foot", figure.soles[side]
        heights.append(((figure.centre[part] - sole[:, :3]) @ figure.frame[part][:, 2] + sole[:, 3]).max())
    return float(np.mean(heights))
