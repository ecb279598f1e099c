"""Clips of the Unitree G1 with 29 joints, for the formats that record that robot.

    clip = g1_clip(path, fps=30.0, root=root, quats=quats, joints=joints)   # (T, 3), (T, 4) wxyz, (T, 29) in JOINTS
    quaternion_order(values)                                                # "wxyz", "xyzw" or "" when it cannot tell

The robot's joints are named in Unitree's order, that of its MJCF; a character with other joints is refused. Files of
this robot seldom say how their quaternions are ordered; the ground tells: in the right order the lowest point keeps
its height and the standing foot its place.
"""

from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.kinematics import kinematics, lowest_point

_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
JOINTS = (
    *(f"left_{name}" for name in _LEG), *(f"right_{name}" for name in _LEG), "waist_yaw", "waist_roll", "waist_pitch",
    *(f"left_{name}" for name in _ARM), *(f"right_{name}" for name in _ARM),
)  # fmt: skip
FEET = ("left_ankle_roll_link", "right_ankle_roll_link")
FRAMES = 600  # that are looked at
CLEARER = 1.5  # times less unrest decides an order; on 16 recorded clips at 5 headings each it was at least 2.8


def load_g1(character: str) -> Character:
    """The character, if its joints are those of the G1 in their order."""
    body = Character.load(character)
    names = [body.model.joint(i).name.removesuffix("_joint") for i in range(1, body.model.njnt)]
    if tuple(names) != JOINTS:
        wrong = next((f"{a!r} for {b!r}" for a, b in zip(names, JOINTS) if a != b), f"{len(names)} joints")  # noqa: B905
        raise ValueError(f"character {character!r} is no G1 with 29 joints in Unitree's order: {wrong}")
    return body


def g1_clip(
    path: Path,
    *,
    fps: float,
    root: np.ndarray,
    quats: np.ndarray,
    joints: np.ndarray,
    loop: bool = False,
    source: str = "",
    character: str = "g1",
) -> Clip:
    """A clip from root positions (T, 3) m, root quaternions (T, 4) wxyz and joint angles (T, 29) rad in JOINTS."""
    load_g1(character)
    if np.abs(joints).max() > 2 * np.pi:
        frame, column = (int(i) for i in np.argwhere(np.abs(joints) > 2 * np.pi)[0])
        reason = f"{joints[frame, column]:.4g} rad is beyond a full turn; are these degrees, or other columns?"
        raise FormatError(path, f"frame {frame}, {JOINTS[column]}", reason)
    qpos = np.concatenate([root, quats, joints], axis=1)
    return Clip(name=path.stem, character=character, fps=fps, qpos=qpos, loop=loop, source=source or path.name)


def quaternion_order(root: np.ndarray, quats: np.ndarray, joints: np.ndarray, character: str = "g1") -> str:
    """Whether quats (T, 4) are "wxyz" or "xyzw"; "" when the motion does not tell."""
    body = load_g1(character)
    q = quats[:FRAMES] / np.linalg.norm(quats[:FRAMES], axis=1, keepdims=True)
    readings = {"wxyz": q, "xyzw": q[:, [3, 0, 1, 2]]}
    poses = {order: np.concatenate([root[:FRAMES], q, joints[:FRAMES]], axis=1) for order, q in readings.items()}
    up = np.array([0.0, 0.0, 1.0])
    upright = {order: float(rotation.rotate(q, up)[:, 2].mean()) for order, q in readings.items()}
    unrest = {order: _unrest(body, qpos) + 1e-4 for order, qpos in poses.items()}
    calm, other = sorted(unrest, key=unrest.__getitem__)
    taller = max(upright, key=upright.__getitem__)
    stands = upright[taller] > 0.7 and upright[taller] - min(upright.values()) > 0.5
    if unrest[other] < CLEARER * unrest[calm]:
        return taller if stands else ""
    return "" if stands and taller != calm else calm


def _unrest(body: Character, qpos: np.ndarray) -> float:
    """How far the lowest point rises and falls, plus how far the calmer foot goes in three frames; metres."""
    low = np.percentile(lowest_point(body, qpos), [10, 90])
    feet = kinematics(body, qpos, 30.0).xpos[:, [body.body_names.index(name) for name in FEET]]
    steps = np.linalg.norm(np.diff(feet, axis=0), axis=-1).min(axis=1)
    return float(low[1] - low[0] + 3 * steps.mean())
