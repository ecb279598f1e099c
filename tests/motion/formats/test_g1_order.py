"""g1.py: joints in Unitree's order or an error; the order of quaternions from the ground, or no answer."""

from pathlib import Path

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.formats import FormatError, read_robot_csv
from kinetok.motion.formats.g1 import JOINTS, g1_clip, load_g1, quaternion_order


def turned(root: np.ndarray, quats: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    turn = rotation.about_z(np.array(angle))
    return rotation.rotate(turn, root), rotation.multiply(turn, quats)


def test_the_joints_are_those_of_the_model():
    body = load_g1("g1")
    assert len(JOINTS) == 29 and body.nq == 36 and len(body.body_names) == 30
    assert [body.model.joint(f"{name}_joint").qposadr[0] for name in JOINTS] == list(range(7, 36))
    with pytest.raises(
        ValueError, match="'humanoid' is no G1 with 29 joints in Unitree's order: 'chest' for 'left_hip"
    ):
        load_g1("humanoid")


@pytest.mark.parametrize("angle", np.deg2rad([0, 60, 90, 151.4, 180, -120]))
def test_the_order_of_a_squat_at_any_heading(squat, angle):
    root, quats = turned(squat.root, squat.quats, angle)
    assert quaternion_order(root, quats, squat.joints) == "wxyz"
    assert quaternion_order(root, quats[:, [1, 2, 3, 0]], squat.joints) == "xyzw"


@pytest.mark.parametrize("name", ["g1_moves/M_ShortMove15", "kimodo_wxyz/kimodo_wave", "kimodo_wxyz/kimodo_walk"])
def test_the_order_of_recorded_clips_at_the_hardest_headings(data_dir, name):
    order = "wxyz" if "kimodo" in name else "xyzw"
    qpos = read_robot_csv(data_dir / "g1" / f"{name}.csv").qpos[:200]
    median = np.median(rotation.heading(qpos[:, 3:7]))
    for angle in (-median, np.pi - median):  # where both orders stand upright, and where one stands on its head
        root, quats = turned(qpos[:, :3], qpos[:, 3:7], angle)
        raw = quats if order == "wxyz" else quats[:, [1, 2, 3, 0]]
        assert quaternion_order(root, raw, qpos[:, 7:]) == order, angle


def test_standing_still_along_x_tells_nothing(squat):
    root, joints = np.tile([0, 0, 0.79], (9, 1)), np.zeros((9, 29))
    along, back = np.tile([0.0, 0, 0, 1], (9, 1)), np.tile([1.0, 0, 0, 0], (9, 1))
    assert quaternion_order(root, along, joints) == ""  # x as x y z w, or backwards as w x y z
    assert quaternion_order(root, back, joints) == "wxyz"  # on its head as x y z w


def test_degrees_are_noticed(squat):
    joints = squat.joints.copy()
    joints[7, 3] = 45.0
    with pytest.raises(FormatError, match="frame 7, left_knee: 45 rad is beyond a full turn; are these degrees"):
        g1_clip(Path("x.csv"), fps=30.0, root=squat.root, quats=squat.quats, joints=joints)


def test_another_model_of_the_robot_fits(squat, data_dir):
    other = str(data_dir / "g1" / "g1_capsules_pd_nomesh.xml")
    clip = g1_clip(Path("x.csv"), fps=30.0, root=squat.root, quats=squat.quats, joints=squat.joints, character=other)
    assert clip.character == other and Character.load(other).nq == 36
