"""poselib.py: files saved as poselib's SkeletonMotion.to_file does it, and AMP's own."""

from collections import OrderedDict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kinetok import rotation
from kinetok.motion.formats import FormatError, read, read_poselib

RNG = np.random.default_rng(0)
NAMES, PARENTS = ["pelvis", "torso", "head", "leg"], [-1, 0, 1, 0]


def tensor(value: np.ndarray) -> dict:
    """poselib's tensor_to_dict."""
    return {"arr": value, "context": {"dtype": value.dtype.name}}


def made(frames: int = 5) -> OrderedDict:
    rotations = Rotation.random(frames * 4, rng=0).as_quat().reshape(frames, 4, 4)  # x y z w
    tree = OrderedDict(
        node_names=list(NAMES),
        parent_indices=tensor(np.array(PARENTS)),
        local_translation=tensor(RNG.uniform(-1, 1, (4, 3)).astype(np.float32)),
    )
    return OrderedDict(
        rotation=tensor(rotations.astype(np.float32)),
        root_translation=tensor(RNG.uniform(-1, 1, (frames, 3)).astype(np.float32)),
        global_velocity=tensor(np.zeros((frames, 4, 3), dtype=np.float32)),
        skeleton_tree=tree,
        is_local=True,
        fps=np.array(60, dtype=np.int32),
        __name__="SkeletonMotion",
    )


def write(tmp_path, data):
    np.save(tmp_path / "hop.npy", data, allow_pickle=True)
    return tmp_path / "hop.npy"


def test_a_file_reads_as_it_was_made(tmp_path):
    data = made()
    (motion,) = read(write(tmp_path, data))
    assert (motion.name, motion.fps, motion.family, motion.joints) == ("hop", 60.0, "", tuple(NAMES))
    assert motion.parents == (-1, 0, 1, 0)
    np.testing.assert_array_equal(motion.offsets, data["skeleton_tree"]["local_translation"]["arr"])
    np.testing.assert_array_equal(motion.root, data["root_translation"]["arr"])
    wanted = data["rotation"]["arr"][..., [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs((motion.local * wanted).sum(-1)), 1, atol=1e-6)


def test_global_rotations_are_made_local(tmp_path):
    data = made()
    local = read_poselib(write(tmp_path, data))
    world = local.pose()[1]
    data |= {"is_local": False, "rotation": tensor(world[..., [1, 2, 3, 0]])}
    back = read_poselib(write(tmp_path, data))
    np.testing.assert_allclose(back.pose()[0], local.pose()[0], atol=1e-6)


def test_amps_own_files(data_dir):
    frames = {"backflip": 29, "cartwheel": 287, "dance": 902, "hop": 297, "run": 82, "walk": 154}
    for path in sorted((data_dir / "train" / "amp_npy").glob("*.npy")):
        motion = read_poselib(path)
        name = path.stem.removeprefix("amp_humanoid_")
        assert (len(motion.root), motion.family, len(motion.joints)) == (frames.pop(name), "amp", 15)
        assert motion.fps == (16 if name == "backflip" else 60)
        pos, _ = motion.pose()
        feet = pos[:, [motion.joints.index("left_foot"), motion.joints.index("right_foot")], 2]
        assert -0.1 < np.percentile(feet.min(1), 5) < 0.2, name
        if name in ("walk", "run"):
            forward = rotation.rotate(motion.local[:, 0], np.array([1.0, 0, 0]))[:, :2].mean(0)
            assert forward @ (motion.root[-1] - motion.root[0])[:2] > 0, name
    assert not frames


def drop(key):
    return lambda data: data.pop(key)


@pytest.mark.parametrize(
    ("change", "where", "reason"),
    [
        (drop("rotation"), "rotation", "is missing; the file holds: root_translation"),
        (drop("fps"), "fps", "is missing"),
        (lambda d: d.update(skeleton_tree=None), "skeleton_tree", "is missing or no dict"),
        (
            lambda d: d["skeleton_tree"].update(node_names=["a", 3]),
            "skeleton_tree.node_names",
            "no list of joint names",
        ),
        (
            lambda d: d["skeleton_tree"].update(node_names=["a"]),
            "parent_indices.arr",
            "has shape (4,); the format has (1,)",
        ),
        (
            lambda d: d["skeleton_tree"]["parent_indices"].update(arr=np.array([-1, 2, 1, 0])),
            "skeleton_tree.parent_indices",
            "the first joint is the root",
        ),
        (lambda d: d["rotation"]["arr"].fill(0), "rotation.arr[0, 0]", "norm 0 is no rotation"),
        (
            lambda d: d["rotation"].update(arr=np.zeros((5, 3, 4))),
            "rotation.arr",
            "has shape (5, 3, 4); the format has (T, 4, 4)",
        ),
        (
            lambda d: d["root_translation"]["arr"].fill(np.nan),
            "root_translation.arr[0, 0]",
            "nan is not a finite number",
        ),
        (lambda d: d["rotation"].update(arr=d["rotation"]["arr"][:1]), "rotation.arr", "1 frames"),
    ],
)
def test_malformed_files(tmp_path, change, where, reason):
    data = made()
    change(data)
    with pytest.raises(FormatError) as caught:
        read_poselib(write(tmp_path, data))
    assert caught.value.where == where and reason in str(caught.value)


def test_other_npy_files(tmp_path):
    with pytest.raises(FormatError, match=r"header: an array \(3, 4\) of float64 without joint names"):
        read_poselib(write(tmp_path, np.zeros((3, 4))))
    with pytest.raises(FormatError, match="pickle: holds a str; a poselib file holds a dict"):
        read_poselib(write(tmp_path, np.array("text", dtype=object)))
    path = write(tmp_path, made())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(FormatError, match="damaged or cut off"):
        read_poselib(path)
    path.write_bytes(b"\x93NUMPY")
    with pytest.raises(FormatError, match="header: not an npy array"):
        read_poselib(path)
