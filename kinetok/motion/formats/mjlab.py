"""mjlab and BeyondMimic motion files: npz of fps, joint_pos (T, 29), body_pos_w, body_quat_w w x y z of the G1.

    clip = read_mjlab(Path("motion.npz"))

body_pos_w (T, 30, 3) and body_quat_w (T, 30, 4) are in the world; body 0 is the pelvis, the root. mjlab lists joints
and bodies depth first, as the MJCF does; tools on Isaac Lab write the same keys breadth first. The body positions
tell which: the order whose kinematics give them back is taken and named in `Clip.source`, and a file that neither
order fits is refused.
"""

from pathlib import Path

import numpy as np

from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.formats.archive import ZipArrays
from kinetok.motion.formats.fields import array, quaternions, rate
from kinetok.motion.formats.g1 import JOINTS, g1_clip, load_g1
from kinetok.motion.kinematics import kinematics

KEYS = {"joint_pos", "body_pos_w", "body_quat_w"}
BODIES = len(JOINTS) + 1
CLOSE = 0.03  # metres between the file's bodies and ours; another joint order is 0.1 and more away
FRAMES = 50  # that are compared


def is_mjlab(path: Path) -> bool:
    """True when an npz has the arrays of this format."""
    return set(ZipArrays(path)) >= KEYS


def read_mjlab(path: Path, *, character: str = "g1") -> Clip:
    """Read one file."""
    data, body = ZipArrays(path), load_g1(character)
    fps, joints = rate(path, data, "fps"), array(path, data, "joint_pos", (None, len(JOINTS)))
    bodies = array(path, data, "body_pos_w", (len(joints), BODIES, 3))
    quats = array(path, data, "body_quat_w", (len(joints), BODIES, 4))[:, 0]
    root, quats = bodies[:, 0], quaternions(path, "body_quat_w[:, 0]", quats, "wxyz")
    orders = {"depth first": np.arange(BODIES), "breadth first": breadth_first(body)}
    errors = {}
    for name, order in orders.items():
        clip = g1_clip(
            path,
            fps=fps,
            root=root,
            quats=quats,
            joints=joints[:, order[1:] - 1],
            source=f"{path.name} ({name})",
            character=character,
        )
        at = np.linspace(0, len(joints) - 1, min(FRAMES, len(joints))).astype(int)
        ours = kinematics(body, clip.qpos[at], fps).xpos
        errors[name] = float(np.linalg.norm(ours - bodies[at][:, order], axis=-1).mean())
        if errors[name] < CLOSE:
            return clip
    found = ", ".join(f"{name} {error:.2f} m" for name, error in errors.items())
    reason = f"joint_pos does not put the bodies there ({found} off): another robot or another order of joints"
    raise FormatError(path, "body_pos_w", reason)


def breadth_first(body: Character) -> np.ndarray:
    """For each body (and, less one, joint) of the MJCF, its place in a breadth-first list, as Isaac Lab makes it."""
    depth = []
    for parent in body.parents:
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
    return np.argsort(np.argsort(depth, kind="stable"), kind="stable")
