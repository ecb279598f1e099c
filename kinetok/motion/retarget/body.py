"""A character as the retargeting sees it: joint centres, bone lengths and frames of its parts, corners of its soles.

    figure = measure(Character.load("g1"))
    figure.bodies["left_thigh"], figure.centre["left_thigh"], figure.frame["left_thigh"], figure.length["left_thigh"]

The character's rest pose (qpos0) stands upright on level feet; where it looks is read off its hips. The centre of a
part is the point nearest to the axes of the joints that carry it, so three hinges in a row count as one hip. Frames
are those of source.py. Refused: a character that lacks parts, or whose limbs have no length.
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np

from kinetok import rotation
from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.motion.retarget.source import LIMBS, SIDES, frame, upright
from kinetok.motion.rigs import REQUIRED

NEEDED = (*REQUIRED, "chest")
ABOVE = {"chest": "pelvis", "head": "chest"} | {
    f"{side}_{part}": above if above in ("pelvis", "chest") else f"{side}_{above}"
    for side in SIDES
    for limb, trunk in zip(LIMBS, ("pelvis", "chest"), strict=True)
    for above, part in zip((trunk, *limb), limb, strict=False)
}
HINGE = mujoco.mjtJoint.mjJNT_HINGE


@dataclass(frozen=True, kw_only=True)
class Figure:
    """Per part: bodies: index into body_names; centre (3,): its joint centre and frame (3, 3): its frame of
    source.py, both in the body's own frame; length: to the next part of its limb, metres. offset (3,): from the part
    above to this one at rest, in that body's frame, for what does not bend: hips and chest from the pelvis (whose
    centre is midway between the hips), shoulders from the chest. soles: side -> (K, 4) points of the foot's shape in
    its body's frame, each with the radius around it."""

    character: Character = field(repr=False)
    bodies: dict[str, int]
    centre: dict[str, np.ndarray]
    frame: dict[str, np.ndarray]
    length: dict[str, float]
    offset: dict[str, np.ndarray]
    soles: dict[str, np.ndarray]


def measure(character: Character) -> Figure:
    """Measure a character in its rest pose."""
    parts = character.parts
    missing = [part for part in NEEDED if part not in parts]
    if missing:
        raise ConfigError(
            f"character {character.name!r}: no body is named for {', '.join(missing)}; add them to its roles file: "
            f'"retarget": {{"{missing[0]}": <body>, ...}}; bodies: {", ".join(character.body_names)}'
        )
    model, data = character.model, mujoco.MjData(character.model)
    mujoco.mj_kinematics(model, data)
    bodies = {part: index for part, index in parts.items() if part in (*NEEDED, "head")}
    tops = {part: bodies[ABOVE[part]] + 1 if part in ABOVE else 0 for part in bodies}
    spot = {part: _centre(model, data, index + 1, tops[part]) for part, index in bodies.items()}
    spot["pelvis"] = (spot["left_thigh"] + spot["right_thigh"]) / 2
    standing = upright(spot["left_thigh"] - spot["right_thigh"], np.array([0.0, 0, 1]))
    frames, length, offset = {}, {}, {}
    for side in SIDES:
        for limb in LIMBS:
            names = [f"{side}_{part}" for part in limb]
            frames |= _limb(character.name, names, spot, _flexion(model, data, bodies, names, standing))
            length |= {a: float(np.linalg.norm(spot[b] - spot[a])) for a, b in zip(names[:2], names[1:], strict=True)}
    frames |= {part: standing for part in ("pelvis", "chest", "head", "left_foot", "right_foot") if part in bodies}
    turn = {part: data.xmat[index + 1].reshape(3, 3) for part, index in bodies.items()}
    for upper, lower in (("pelvis", "thigh"), ("chest", "upper_arm"), ("pelvis", "chest")):
        for part in (lower,) if lower == "chest" else (f"left_{lower}", f"right_{lower}"):
            offset[part] = turn[upper].T @ (spot[part] - spot[upper])
    return Figure(
        character=character,
        bodies=bodies,
        centre={part: turn[part].T @ (spot[part] - data.xpos[index + 1]) for part, index in bodies.items()},
        frame={part: turn[part].T @ frames[part] for part in frames},
        length=length,
        offset=offset,
        soles={side: _sole(model, bodies[f"{side}_foot"] + 1) for side in SIDES},
    )


def _centre(model: mujoco.MjModel, data: mujoco.MjData, body: int, above: int) -> np.ndarray:
    """World point (3,) nearest to the axes of the joints from `body` up to, not including, the body `above`."""
    matrix, origin = 1e-6 * np.eye(3), data.xpos[body].copy()
    vector = matrix @ origin
    while body not in (above, 0):
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            axis = data.xaxis[joint] * (model.jnt_type[joint] == HINGE)  # a ball is met in its anchor
            across = np.eye(3) - np.outer(axis, axis)
            matrix, vector = matrix + across, vector + across @ data.xanchor[joint]
        body = model.body_parentid[body]
    return np.linalg.solve(matrix, vector)


def _limb(name: str, parts: list[str], spot: dict[str, np.ndarray], flexion: np.ndarray) -> dict[str, np.ndarray]:
    """World frames at rest of the two bones of a limb."""
    bones = [spot[lower] - spot[upper] for upper, lower in zip(parts[:2], parts[1:], strict=True)]
    for part, bone in zip(parts, bones, strict=False):
        if np.linalg.norm(bone) < 0.01:
            raise ConfigError(f'character {name!r}: {part} is shorter than 1 cm; look at its roles file, "retarget"')
    upper, lower = (frame(bone, flexion) for bone in bones)
    return dict(zip(parts, (upper, lower, lower), strict=True))  # a hand goes on as its arm; feet are overwritten


def _flexion(
    model: mujoco.MjModel, data: mujoco.MjData, bodies: dict[str, int], parts: list[str], standing: np.ndarray
) -> np.ndarray:
    """World axis (3,) about which knee or elbow flexes: the hinge, signed so that it bends farther that way."""
    upper, lower, end = (bodies[part] + 1 for part in parts)
    ahead, left = standing[:, 0], standing[:, 1]
    guess = left if "shin" in parts[1] else np.cross(data.xpos[lower] - data.xpos[upper], ahead)
    joint = model.body_jntadr[lower]
    if model.body_jntnum[lower] != 1 or model.jnt_type[joint] != HINGE:
        return guess
    axis = data.xaxis[joint]
    if not model.jnt_limited[joint]:
        return axis * np.sign(axis @ guess)
    # how far the lower bone is already turned about the axis at rest (the G1's elbow rests at a right angle)
    along, onward = data.xanchor[joint] - data.xpos[upper], data.xpos[end] - data.xanchor[joint]
    rest = np.arctan2(np.cross(along, onward) @ axis, along @ onward - (along @ axis) * (onward @ axis))
    low, high = model.jnt_range[joint] - data.qpos[model.jnt_qposadr[joint]] + rest
    return axis if high > -low else -axis


def _sole(model: mujoco.MjModel, foot: int) -> np.ndarray:
    """Points and radii (K, 4) of the geoms of a foot's body, in its frame."""
    points = []
    for geom in np.flatnonzero(model.geom_bodyid == foot):
        kind, size = model.geom_type[geom], model.geom_size[geom]
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            ends, radius = np.zeros((1, 3)), size[0]
        elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            ends, radius = np.array([[0, 0, -size[1]], [0, 0, size[1]]]), size[0]
        else:
            box = model.geom_aabb[geom]
            ends, radius = box[:3] + box[3:] * (np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1), 0.0
        ends = model.geom_pos[geom] + rotation.rotate(np.broadcast_to(model.geom_quat[geom], (len(ends), 4)), ends)
        points.append(np.column_stack([ends, np.full(len(ends), radius)]))
    return np.concatenate(points) if points else np.zeros((1, 4))
