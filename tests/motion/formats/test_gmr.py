"""gmr.py: files pickled as general-motion-retargeting's scripts do it."""

import pickle

import numpy as np
import pytest

from kinetok.motion.formats import FormatError, read, read_gmr


def made(squat) -> dict:
    """What scripts/smplx_to_robot.py dumps."""
    return {
        "fps": 30,
        "root_pos": squat.root.copy(),
        "root_rot": squat.xyzw.copy(),
        "dof_pos": squat.joints.copy(),
        "local_body_pos": None,
        "link_body_list": None,
    }


def write(tmp_path, data):
    path = tmp_path / "squat.pkl"
    path.write_bytes(pickle.dumps(data))
    return path


def test_a_file_reads_as_it_was_made(tmp_path, squat):
    (clip,) = read(write(tmp_path, made(squat)))
    assert (clip.name, clip.character, clip.fps, clip.source) == ("squat", "g1", 30.0, "squat.pkl")
    np.testing.assert_allclose(clip.qpos, squat.qpos, atol=1e-12)


@pytest.mark.parametrize(
    ("key", "value", "where", "reason"),
    [
        ("dof_pos", lambda d: d["dof_pos"][:, :23], "dof_pos", "has shape (40, 23); the format has (40, 29)"),
        ("dof_pos", lambda d: d["dof_pos"][:-1], "dof_pos", "has shape (39, 29); the format has (40, 29)"),
        ("root_pos", lambda d: d["root_pos"][:1], "root_pos", "1 frames"),
        ("root_pos", lambda d: d["root_pos"] * np.nan, "root_pos[0, 0]", "nan is not a finite number"),
        ("root_rot", lambda d: d["root_rot"] * 0, "root_rot[0]", "norm 0 is no rotation"),
        ("root_rot", lambda d: d["root_rot"][:, [3, 0, 1, 2]], "root_rot", "GMR writes x y z w"),
        ("fps", lambda d: 0, "fps", "0 is no frame rate"),
        ("fps", lambda d: None, "fps", "is NoneType, not numbers"),
    ],
)
def test_malformed_files(tmp_path, squat, key, value, where, reason):
    data = made(squat)
    data[key] = value(data)
    with pytest.raises(FormatError) as caught:
        read_gmr(write(tmp_path, data))
    assert caught.value.where == where and reason in str(caught.value)


def test_a_missing_key(tmp_path, squat):
    data = made(squat)
    del data["dof_pos"]
    with pytest.raises(FormatError, match="dof_pos: is missing; the file holds: fps, root_pos, root_rot"):
        read_gmr(write(tmp_path, data))
