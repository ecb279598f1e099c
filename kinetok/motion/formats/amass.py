"""AMASS motion files (npz of SMPL, SMPL-H or SMPL-X poses), and files of that layout written from a skeleton.

    motion = read_amass(Path("walk_poses.npz"))
    write_amass(Path("walk_poses.npz"), motion)       # a motion whose joints are SMPL's

z up, metres, axis-angle. Read are the 22 body joints and the root's path: poses (T, 72, 156 or 165) begins with them;
without it root_orient (T, 3) and pose_body (T, 63); trans (T, 3); mocap_framerate or mocap_frame_rate. Hands, face
and soft tissue are left out. The body is always the average one of motion.smpl: betas and gender are ignored, since
making the subject's own skeleton of them takes the SMPL model, which we do not have. trans is taken as the pelvis;
SMPL's lies a constant few centimetres from it.
"""

import os
from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.error import FormatError
from kinetok.motion.formats.archive import ZipArrays
from kinetok.motion.formats.fields import array, rate
from kinetok.motion.skeleton import SkeletonMotion
from kinetok.motion.smpl import JOINTS, OFFSETS, PARENTS

BODY = 3 * len(JOINTS)
WIDTHS = (72, 156, 165)  # of poses: SMPL, SMPL-H, SMPL-X
RATES = ("mocap_framerate", "mocap_frame_rate")
ASIDE = np.cos(np.deg2rad(40))  # of a limb at rest from the T-pose


def is_amass(path: Path) -> bool:
    """True when an npz has poses and a path."""
    keys = set(ZipArrays(path))
    return "trans" in keys and ("poses" in keys or {"root_orient", "pose_body"} <= keys)


def read_amass(path: Path) -> SkeletonMotion:
    """Read one file as a motion of the average SMPL body."""
    data = ZipArrays(path)
    if "poses" in data or "root_orient" not in data:
        poses = array(path, data, "poses", (None, None))
        if poses.shape[1] not in WIDTHS:
            reason = f"{poses.shape[1]} columns; SMPL has 72, SMPL-H 156, SMPL-X 165"
            raise FormatError(path, "poses", reason)
    else:
        orient = array(path, data, "root_orient", (None, 3))
        poses = np.concatenate([orient, array(path, data, "pose_body", (len(orient), BODY - 3))], axis=1)
    return SkeletonMotion(
        name=path.stem,
        fps=rate(path, data, RATES[1] if RATES[1] in data else RATES[0]),
        joints=JOINTS,
        parents=PARENTS,
        offsets=OFFSETS,
        local=rotation.align(rotation.from_rotvec(poses[:, :BODY].reshape(len(poses), len(JOINTS), 3))),
        root=array(path, data, "trans", (len(poses), 3)),
        family="smpl",
        source=f"{path.name} (average body, betas ignored)",
    )


def write_amass(path: Path, motion: SkeletonMotion) -> None:
    """Write a motion in SMPL-H's layout; hands and betas are zero, joints beyond the 22 are left out.

    Raises ValueError when joints are missing, hang from others than SMPL's, or do not rest in SMPL's T-pose.
    """
    missing = [name for name in JOINTS if name not in motion.joints]
    if missing:
        raise ValueError(f"motion {motion.name!r} lacks SMPL's joints {', '.join(missing)}")
    at = [motion.joints.index(name) for name in JOINTS]
    for joint, parent in enumerate(PARENTS):
        above = motion.parents[at[joint]]
        if parent >= 0 and above != at[parent]:
            hangs = f"{JOINTS[joint]} hangs from {motion.joints[above]!r}; in SMPL from {JOINTS[parent]}"
            raise ValueError(f"motion {motion.name!r}: {hangs}")
    for joint in (JOINTS.index(f"{side}_{name}") for side in ("left", "right") for name in ("knee", "ankle", "elbow")):
        rest, wanted = motion.offsets[at[joint]], OFFSETS[joint]
        if rest @ wanted < ASIDE * np.linalg.norm(rest) * np.linalg.norm(wanted):
            raise ValueError(
                f"motion {motion.name!r}: {JOINTS[joint]} rests along {np.round(rest, 2).tolist()}; SMPL's T-pose "
                f"(y up, facing z) has {wanted.tolist()}"
            )
    poses = np.zeros((len(motion.root), WIDTHS[1]))
    poses[:, :BODY] = rotation.to_rotvec(motion.local[:, at]).reshape(len(poses), -1)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("wb") as file:
        np.savez(
            file,
            poses=poses,
            trans=motion.root,
            betas=np.zeros(16),
            gender=np.array("neutral"),
            mocap_framerate=np.float64(motion.fps),
        )
    os.replace(temporary, path)
