"""MimicKit motion files: a pickled dict of loop_mode (0 clamp, 1 wrap), fps and frames (T, 6 + degrees of freedom).

    clip = read_mimickit(Path("humanoid_walk.pkl"))      # 28: the humanoid; 29: the Unitree G1

A frame is the root's position (m, z up), its rotation vector and the joints depth first: rotation vectors of joints
with three axes, angles of hinges. Which body a file is of shows only in the number of its columns; others than those
of the two built-in characters are refused. MimicKit's humanoid rests in a T-pose and ours with lowered arms, so the
shoulders are turned into our frames.
"""

from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.formats.fields import array, rate
from kinetok.motion.formats.g1 import JOINTS as G1_JOINTS
from kinetok.motion.formats.g1 import g1_clip
from kinetok.motion.formats.unpickle import load_dict

KEYS = (b"loop_mode", b"frames", b"fps")
QUARTER = np.pi / 2
# MimicKit's order: joint in our MJCF, columns, and for hinges the sign of the angle. Its upper arms lie along y,
# ours along -z of their frames: `TURN` is our frame seen from theirs, a quarter turn about x.
JOINTS = (
    ("chest", 3, 0), ("neck", 3, 0),
    ("right_shoulder", 3, 0), ("right_elbow", 1, 1), ("left_shoulder", 3, 0), ("left_elbow", 1, -1),
    ("right_hip", 3, 0), ("right_knee", 1, 1), ("right_ankle", 3, 0),
    ("left_hip", 3, 0), ("left_knee", 1, 1), ("left_ankle", 3, 0),
)  # fmt: skip
TURN = {"right_shoulder": -QUARTER, "left_shoulder": QUARTER}
HUMANOID = sum(width for _, width, _ in JOINTS)


def is_mimickit(path: Path) -> bool:
    """True when a pickle names the keys of this format."""
    data = path.read_bytes()
    return all(key in data for key in KEYS)


def read_mimickit(path: Path) -> Clip:
    """Read one file as a clip of "humanoid" or "g1"."""
    data = load_dict(path)
    fps, frames = rate(path, data, "fps"), array(path, data, "frames", (None, None))
    mode = int(array(path, data, "loop_mode", ()))
    if mode not in (0, 1):
        raise FormatError(path, "loop_mode", f"{mode}; it is 0 (clamp) or 1 (wrap)")
    root, quats, joints = frames[:, :3], rotation.align(rotation.from_rotvec(frames[:, 3:6])), frames[:, 6:]
    if joints.shape[1] == HUMANOID:
        body = Character.load("humanoid")
        qpos = np.concatenate([root, quats, np.zeros((len(root), body.nq - 7))], axis=1)
        _pose(body, qpos, joints)
        clip = Clip(name=path.stem, character="humanoid", fps=fps, qpos=qpos, loop=mode == 1, source=path.name)
    elif joints.shape[1] == len(G1_JOINTS):
        clip = g1_clip(path, fps=fps, root=root, quats=quats, joints=joints, loop=mode == 1)
    else:
        raise FormatError(
            path, "frames", f"{joints.shape[1]} degrees of freedom; known: {HUMANOID} (humanoid), {len(G1_JOINTS)} (g1)"
        )
    return clip


def _pose(body: Character, qpos: np.ndarray, joints: np.ndarray) -> None:
    """Write MimicKit's joint columns (T, 28) into the poses (T, nq) of our humanoid."""
    column = 0
    for name, width, sign in JOINTS:
        joint = body.model.joint(name)
        at, values = int(joint.qposadr[0]), joints[:, column : column + width]
        if width == 1:
            qpos[:, at] = sign * values[:, 0]
        else:
            rest = body.model.body_quat[int(joint.bodyid[0])]
            turn = rotation.from_rotvec(np.array([TURN.get(name, 0.0), 0.0, 0.0]))
            theirs = rotation.multiply(rotation.from_rotvec(values), turn)
            qpos[:, at : at + 4] = rotation.align(rotation.multiply(rotation.conjugate(rest), theirs))
        column += width
