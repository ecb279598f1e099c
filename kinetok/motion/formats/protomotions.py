"""ProtoMotions motion files (.motion): what torch.save makes of a dict of tensors; read without torch.

    motion = read_protomotions(Path("walk.motion"))     # SkeletonMotion of SMPL's humanoid, or a Clip of the G1

Read are fps, rigid_body_pos (T, B, 3), rigid_body_rot (T, B, 4) x y z w, both in the world, and dof_pos. Files name no
bodies: 29 degrees of freedom are the G1's joints, its root body 0; 24 bodies are those of smpl_humanoid.xml, which
become a skeleton whose offsets are measured from the positions. Other bodies are refused.
"""

from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.formats.archive import member_names, read_member
from kinetok.motion.formats.fields import array, quaternions, rate
from kinetok.motion.formats.g1 import JOINTS, g1_clip
from kinetok.motion.formats.unpickle import load_plain
from kinetok.motion.skeleton import SkeletonMotion

# smpl_humanoid.xml, depth first: SMPL's name of the body and its parent
SMPL = (
    ("pelvis", ""), ("left_hip", "pelvis"), ("left_knee", "left_hip"), ("left_ankle", "left_knee"),
    ("left_foot", "left_ankle"), ("right_hip", "pelvis"), ("right_knee", "right_hip"), ("right_ankle", "right_knee"),
    ("right_foot", "right_ankle"), ("spine1", "pelvis"), ("spine2", "spine1"), ("spine3", "spine2"),
    ("neck", "spine3"), ("head", "neck"), ("left_collar", "spine3"), ("left_shoulder", "left_collar"),
    ("left_elbow", "left_shoulder"), ("left_wrist", "left_elbow"), ("left_hand", "left_wrist"),
    ("right_collar", "spine3"), ("right_shoulder", "right_collar"), ("right_elbow", "right_shoulder"),
    ("right_wrist", "right_elbow"), ("right_hand", "right_wrist"),
)  # fmt: skip
RIGID = 0.01  # metres a joint may move in its parent's frame; more is another order of bodies


def read_protomotions(path: Path, *, character: str = "g1") -> SkeletonMotion | Clip:
    """Read one file."""
    data = load_tensors(path)
    pos = array(path, data, "rigid_body_pos", (None, None, 3))
    raw, fps = array(path, data, "rigid_body_rot", (*pos.shape[:2], 4)), rate(path, data, "fps")
    rot = quaternions(path, "rigid_body_rot", raw, "xyzw")
    if pos.shape[1] == len(SMPL):
        return _skeleton(path, fps, pos, rot)
    joints = array(path, data, "dof_pos", (len(pos), None))
    if joints.shape[1] == len(JOINTS):
        return g1_clip(path, fps=fps, root=pos[:, 0], quats=rot[:, 0], joints=joints, character=character)
    reason = f"{pos.shape[1]} bodies and {joints.shape[1]} degrees of freedom, and no names; known: {len(SMPL)} bodies "
    raise FormatError(path, "rigid_body_pos", f"{reason}(SMPL's humanoid) or {len(JOINTS)} degrees of freedom (g1)")


def load_tensors(path: Path) -> dict:
    """The dict in a zip file of torch.save; tensors become arrays."""
    pickles = [name for name in member_names(path) if name.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise FormatError(path, "archive", "no data.pkl; a .motion file is what torch.save writes")
    folder = pickles[0].removesuffix("data.pkl")
    if f"{folder}byteorder" in member_names(path) and read_member(path, f"{folder}byteorder") != b"little":
        raise FormatError(path, "byteorder", "is not little; save the file again on a usual machine")
    data = load_plain(read_member(path, pickles[0]), path, storage=lambda key: read_member(path, f"{folder}data/{key}"))
    if not isinstance(data, dict):
        raise FormatError(path, "data.pkl", f"holds a {type(data).__name__}; a motion is a dict of tensors")
    return data


def _skeleton(path: Path, fps: float, pos: np.ndarray, rot: np.ndarray) -> SkeletonMotion:
    names = [name for name, _ in SMPL]
    parents = [names.index(parent) if parent else -1 for _, parent in SMPL]
    offsets, local = np.zeros((len(names), 3)), rot.copy()
    for joint, parent in enumerate(parents):
        if parent < 0:
            continue
        back = rotation.conjugate(rot[:, parent])
        local[:, joint] = rotation.align(rotation.multiply(back, rot[:, joint]))
        arm = rotation.rotate(back, pos[:, joint] - pos[:, parent])
        offsets[joint] = np.median(arm, axis=0)
        drift = np.linalg.norm(arm - offsets[joint], axis=1)
        if drift.max() > RIGID:
            reason = f"body {joint} moves {drift.max():.3f} m against body {parent}; not SMPL's order of bodies"
            raise FormatError(path, f"rigid_body_pos, frame {int(drift.argmax())}", reason)
    return SkeletonMotion(
        name=path.stem,
        fps=fps,
        joints=tuple(names),
        parents=tuple(parents),
        offsets=offsets,
        local=local,
        root=pos[:, 0],
        family="smpl",
        source=path.name,
    )
