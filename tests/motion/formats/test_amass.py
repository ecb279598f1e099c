"""amass.py: both layouts give the same body motion; what is written reads back; other skeletons are refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kinetok.motion.formats import FormatError, read, read_amass, write_amass
from kinetok.motion.skeleton import SkeletonMotion
from kinetok.motion.smpl import JOINTS, OFFSETS, PARENTS

RNG = np.random.default_rng(0)
UPRIGHT = np.array([np.pi / 2, 0, 0])  # y up to z up: a standing body's root in AMASS


def smplh(frames: int = 6) -> dict:
    """A file of SMPL-H's layout, upright and moving its joints."""
    poses = RNG.uniform(-0.3, 0.3, (frames, 156))
    poses[:, :3] = UPRIGHT
    trans = np.stack([np.linspace(0, 1, frames), np.zeros(frames), np.full(frames, 0.95)], axis=1)
    return {
        "poses": poses,
        "trans": trans,
        "betas": np.zeros(16),
        "dmpls": np.zeros((frames, 8)),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(120.0),
    }


def write(tmp_path, data):
    np.savez(tmp_path / "walk_poses.npz", **data)
    return tmp_path / "walk_poses.npz"


def test_poses_and_path_are_those_of_the_file(tmp_path):
    data = smplh()
    (motion,) = read(write(tmp_path, data))
    assert (motion.name, motion.fps, motion.family, motion.unit) == ("walk_poses", 120.0, "smpl", "m")
    assert motion.joints == JOINTS and len(JOINTS) == 22 and "betas ignored" in motion.source
    np.testing.assert_array_equal(motion.root, data["trans"])
    for frame in range(6):
        for joint in range(22):
            turned = Rotation.from_quat(motion.local[frame, joint], scalar_first=True)
            wanted = Rotation.from_rotvec(data["poses"][frame, 3 * joint : 3 * joint + 3])
            assert (turned * wanted.inv()).magnitude() < 1e-9


def test_a_body_at_rest_stands_in_a_t_pose_facing_minus_y(tmp_path):
    data = smplh()
    data["poses"] = np.tile(np.concatenate([UPRIGHT, np.zeros(153)]), (6, 1))
    pos, _ = read_amass(write(tmp_path, data)).pose()
    place = {name: pos[0, index] - pos[0, 0] for index, name in enumerate(JOINTS)}
    assert place["head"][2] > 0.5 and place["left_ankle"][2] < -0.8
    assert place["left_wrist"][0] > 0.6 and place["right_wrist"][0] < -0.6
    assert place["left_foot"][1] < place["left_ankle"][1] - 0.1


def test_every_layout_holds_the_same_motion(tmp_path):
    data = smplh()
    wanted, poses = read_amass(write(tmp_path, data)), data.pop("poses")
    del data["mocap_framerate"]
    data["mocap_frame_rate"] = np.array(120.0)
    parts = {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66]}
    for layout in ({"poses": poses[:, :72]}, {"poses": np.pad(poses, ((0, 0), (0, 9)))}, parts):
        np.testing.assert_array_equal(read_amass(write(tmp_path, data | layout)).local, wanted.local)


def test_written_files_read_back(tmp_path):
    motion = read_amass(write(tmp_path, smplh()))
    path = tmp_path / "new" / "copy.npz"
    write_amass(path, motion)
    back = read_amass(path)
    assert (back.fps, back.joints) == (motion.fps, motion.joints)
    np.testing.assert_allclose(back.root, motion.root, atol=1e-12)
    np.testing.assert_allclose(np.abs((back.local * motion.local).sum(-1)), 1, atol=1e-12)
    assert [p.name for p in path.parent.iterdir()] == ["copy.npz"]
    with np.load(path, allow_pickle=False) as file:
        assert file["poses"].shape == (6, 156) and not file["poses"][:, 66:].any()
        assert str(file["gender"]) == "neutral" and float(file["mocap_framerate"]) == 120.0


def skeleton(joints=JOINTS, parents=PARENTS, offsets=OFFSETS) -> SkeletonMotion:
    local = np.zeros((3, len(joints), 4))
    local[..., 0] = 1
    return SkeletonMotion(
        name="made", fps=30, joints=joints, parents=parents, offsets=offsets, local=local, root=np.zeros((3, 3))
    )


def test_other_skeletons_are_not_written(tmp_path):
    path = tmp_path / "x.npz"
    with pytest.raises(ValueError, match="'made' lacks SMPL's joints left_wrist, right_wrist"):
        write_amass(path, skeleton(JOINTS[:-2], PARENTS[:-2], OFFSETS[:-2]))
    parents = list(PARENTS)
    parents[JOINTS.index("left_knee")] = 0
    with pytest.raises(ValueError, match="left_knee hangs from 'pelvis'; in SMPL from left_hip"):
        write_amass(path, skeleton(parents=tuple(parents)))
    with pytest.raises(
        ValueError, match=r"left_knee rests along \[-0.01, -0.0, -0.41\]; SMPL's T-pose \(y up, facing z"
    ):
        write_amass(path, skeleton(offsets=np.stack([-OFFSETS[:, 0], -OFFSETS[:, 2], OFFSETS[:, 1]], axis=1)))
    assert not path.exists()


def test_the_collected_files(data_dir):
    motions = {path.name: read_amass(path) for path in sorted((data_dir / "smpl").glob("*.npz"))}
    assert len(motions) == 4
    for name, motion in motions.items():
        pos, _ = motion.pose()
        feet = pos[:, [JOINTS.index("left_foot"), JOINTS.index("right_foot")], 2].min(1)
        assert -0.12 < np.percentile(feet, 5) < 0.1, name
        assert (pos[:, JOINTS.index("head"), 2] > pos[:, 0, 2] + 0.3).all(), name
    walk, same = motions["synthetic_walk_12_01_poses.npz"], motions["synthetic_walk_12_01_stageii.npz"]
    np.testing.assert_allclose(np.abs((walk.local * same.local).sum(-1)), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("key", "value", "where", "reason"),
    [
        ("poses", np.zeros((6, 63)), "poses", "63 columns; SMPL has 72, SMPL-H 156, SMPL-X 165"),
        ("poses", np.zeros((1, 156)), "poses", "1 frames; a motion needs at least two"),
        ("poses", np.full((6, 156), np.nan), "poses[0, 0]", "nan is not a finite number"),
        ("poses", np.zeros((6, 156), dtype=object), "poses", "holds Python objects, which are never loaded"),
        ("trans", np.zeros((5, 3)), "trans", "has shape (5, 3); the format has (6, 3)"),
        ("mocap_framerate", np.array(0.0), "mocap_framerate", "0.0 is no frame rate"),
        ("mocap_framerate", np.array("120"), "mocap_framerate", "is <U3, not numbers"),
    ],
)
def test_malformed_files(tmp_path, key, value, where, reason):
    with pytest.raises(FormatError) as caught:
        read_amass(write(tmp_path, smplh() | {key: value}))
    assert caught.value.where == where and reason in str(caught.value)


def test_missing_keys(tmp_path):
    data = smplh()
    del data["mocap_framerate"]
    with pytest.raises(FormatError, match="mocap_framerate: is missing; the file holds: poses, trans, betas"):
        read_amass(write(tmp_path, data))
