"""mjlab.py: files saved as mjlab's csv_to_npz and Isaac Lab's do it."""

import numpy as np
import pytest

from kinetok.motion.formats import FormatError, read, read_mjlab
from kinetok.motion.formats.g1 import load_g1
from kinetok.motion.formats.mjlab import breadth_first
from kinetok.motion.kinematics import kinematics

# SONIC's table: Isaac Lab's place of each joint in MuJoCo's order
ISAAC = [0, 3, 6, 9, 13, 17, 1, 4, 7, 10, 14, 18, 2, 5, 8, 11, 15, 19, 21, 23, 25, 27, 12, 16, 20, 22, 24, 26, 28]


def made(squat) -> dict[str, np.ndarray]:
    motion = kinematics(load_g1("g1"), squat.qpos, 50.0)
    return {
        "fps": np.array([50]),
        "joint_pos": squat.joints.astype(np.float32),
        "joint_vel": motion.qvel[:, 6:].astype(np.float32),
        "body_pos_w": motion.xpos.astype(np.float32),
        "body_quat_w": motion.xquat.astype(np.float32),
        "body_lin_vel_w": motion.linear.astype(np.float32),
        "body_ang_vel_w": motion.angular.astype(np.float32),
    }


def write(tmp_path, data):
    np.savez(tmp_path / "squat.npz", **data)
    return tmp_path / "squat.npz"


def test_a_file_reads_as_it_was_made(tmp_path, squat):
    (clip,) = read(write(tmp_path, made(squat)))
    assert (clip.name, clip.character, clip.fps, clip.source) == ("squat", "g1", 50.0, "squat.npz (depth first)")
    np.testing.assert_allclose(clip.qpos, squat.qpos, atol=1e-5)


def test_isaac_labs_order_is_recognised(tmp_path, squat):
    data, body = made(squat), load_g1("g1")
    order = breadth_first(body)
    assert (order[1:] - 1).tolist() == ISAAC
    place = np.argsort(order)
    data |= {key: data[key][:, place] for key in ("body_pos_w", "body_quat_w")}
    data["joint_pos"] = data["joint_pos"][:, place[1:] - 1]
    clip = read_mjlab(write(tmp_path, data))
    assert clip.source == "squat.npz (breadth first)"
    np.testing.assert_allclose(clip.qpos, squat.qpos, atol=1e-5)


@pytest.mark.parametrize(
    ("key", "value", "where", "reason"),
    [
        ("joint_pos", lambda v: v[:, ::-1], "body_pos_w", "joint_pos does not put the bodies there (depth first 0."),
        ("joint_pos", lambda v: v[:, :23], "joint_pos", "has shape (40, 23); the format has (T, 29)"),
        ("body_pos_w", lambda v: v[:, :14], "body_pos_w", "has shape (40, 14, 3); the format has (40, 30, 3)"),
        ("body_quat_w", lambda v: v * 0, "body_quat_w[:, 0][0]", "norm 0 is no rotation"),
        ("body_quat_w", lambda v: v * np.nan, "body_quat_w[0, 0, 0]", "nan is not a finite number"),
        ("fps", lambda v: v * 0, "fps", "[0] is no frame rate"),
        ("joint_pos", lambda v: v.astype(object), "joint_pos", "holds Python objects, which are never loaded"),
    ],
)
def test_malformed_files(tmp_path, squat, key, value, where, reason):
    data = made(squat)
    data[key] = value(data[key])
    with pytest.raises(FormatError) as caught:
        read_mjlab(write(tmp_path, data))
    assert caught.value.where == where and reason in str(caught.value)
