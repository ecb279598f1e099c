"""poselib motion files (.npy): a pickled OrderedDict of a skeleton tree, local rotations and root path; AMP's clips.

    motion = read_poselib(Path("amp_humanoid_walk.npy"))

Keys read: rotation.arr (T, J, 4) x y z w, root_translation.arr (T, 3) m, is_local, fps, and of skeleton_tree the
node_names, parent_indices.arr and local_translation.arr (J, 3). Global rotations (is_local false) are made local.
An npy of bare numbers is refused: it names no joints.
"""

from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.error import FormatError
from kinetok.motion.formats.archive import MAGIC, parse_header
from kinetok.motion.formats.fields import array, quaternions, rate
from kinetok.motion.formats.unpickle import load_plain
from kinetok.motion.skeleton import SkeletonMotion

AMP = {"pelvis", "torso", "head", "right_upper_arm", "left_thigh", "right_foot"}  # names AMP's humanoid is known by


def is_poselib(path: Path) -> bool:
    """True when an npy file holds Python objects."""
    with path.open("rb") as file:
        head = file.read(128)
    return head.startswith(MAGIC) and b"'|O'" in head


def read_poselib(path: Path) -> SkeletonMotion:
    """Read one file."""
    data = _load(path)
    tree = _section(path, data, "skeleton_tree")
    names = tree.get("node_names")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise FormatError(path, "skeleton_tree.node_names", "is no list of joint names")
    count = len(names)
    parents = _tensor(path, tree, "parent_indices", (count,))
    if parents[0] != -1 or any(not 0 <= p < j or p % 1 for j, p in enumerate(parents) if j):
        raise FormatError(path, "skeleton_tree.parent_indices", "the first joint is the root, others follow a parent")
    offsets = _tensor(path, tree, "local_translation", (count, 3))
    raw = _tensor(path, data, "rotation", (None, count, 4))
    local = quaternions(path, "rotation.arr", raw, "xyzw")
    if "is_local" in data and not array(path, data, "is_local", ()):
        above = local[:, parents[1:].astype(int)]
        local[:, 1:] = rotation.align(rotation.multiply(rotation.conjugate(above), local[:, 1:]))
    return SkeletonMotion(
        name=path.stem,
        fps=rate(path, data, "fps"),
        joints=tuple(names),
        parents=tuple(int(p) for p in parents),
        offsets=offsets,
        local=local,
        root=_tensor(path, data, "root_translation", (len(raw), 3)),
        family="amp" if set(names) >= AMP else "",
        source=path.name,
    )


def _load(path: Path) -> dict:
    data = path.read_bytes()
    start, shape, _, dtype = parse_header(path, "header", data)
    if not dtype.hasobject or shape != ():
        reason = f"an array {shape} of {dtype} without joint names; a poselib file holds a dict"
        raise FormatError(path, "header", reason)
    value = load_plain(data[start:], path)
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if not isinstance(value, dict):
        raise FormatError(path, "pickle", f"holds a {type(value).__name__}; a poselib file holds a dict")
    return value


def _tensor(path: Path, data: dict, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    section = {f"{key}.{name}": value for name, value in _section(path, data, key).items()}
    return array(path, section, f"{key}.arr", shape)


def _section(path: Path, data: dict, key: str) -> dict:
    if not isinstance(data.get(key), dict):
        reason = "is missing or no dict" if key in data else f"is missing; the file holds: {', '.join(map(str, data))}"
        raise FormatError(path, key, reason)
    return data[key]
