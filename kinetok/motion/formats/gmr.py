"""GMR motion files: a pickled dict of fps, root_pos (T, 3), root_rot (T, 4) x y z w and dof_pos (T, 29) of the G1.

    clip = read_gmr(Path("walk.pkl"))

Written by general-motion-retargeting and the tools around it. Refused: its other robots, by their joint count, and a
root_rot with which the robot stands on the ground only when it is read as w x y z.
"""

from pathlib import Path

from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.formats.fields import array, quaternions, rate
from kinetok.motion.formats.g1 import g1_clip, quaternion_order
from kinetok.motion.formats.unpickle import load_dict

KEYS = (b"root_pos", b"root_rot", b"dof_pos")


def is_gmr(path: Path) -> bool:
    """True when a pickle names the keys of this format."""
    data = path.read_bytes()
    return all(key in data for key in KEYS)


def read_gmr(path: Path, *, character: str = "g1") -> Clip:
    """Read one file."""
    data = load_dict(path)
    root = array(path, data, "root_pos", (None, 3))
    raw, joints = array(path, data, "root_rot", (len(root), 4)), array(path, data, "dof_pos", (len(root), 29))
    quats = quaternions(path, "root_rot", raw, "xyzw")
    if quaternion_order(root, raw, joints, character) == "wxyz":
        raise FormatError(path, "root_rot", "only as w x y z does the robot stand on the ground; GMR writes x y z w")
    return g1_clip(path, fps=rate(path, data, "fps"), root=root, quats=quats, joints=joints, character=character)
