"""The built-in g1: its kinematics, masses and limits against the robot's, and that it stands."""

import re

import mujoco
import numpy as np
import pytest

from kinetok.motion.character import Character, read_mjcf
from kinetok.rotation import rotate
from kinetok.sim.batch import BatchSim
from kinetok.sim.scene import SceneConfig, build_scene

LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
ORDER = [
    *(f"left_{j}_joint" for j in LEG), *(f"right_{j}_joint" for j in LEG),
    "waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint",
    *(f"left_{j}_joint" for j in ARM), *(f"right_{j}_joint" for j in ARM),
]  # fmt: skip
CONTROL_HZ = 30


@pytest.fixture(scope="module")
def g1():
    return Character.load("g1")


@pytest.fixture(scope="module")
def source(data_dir):
    path = data_dir / "g1" / "g1_capsules_pd_nomesh.xml"
    if not path.exists():
        pytest.skip("the robot's published MJCF is absent: data/g1/g1_capsules_pd_nomesh.xml")
    return mujoco.MjModel.from_xml_string(read_mjcf(path))


def test_sizes_and_order(g1):
    assert (g1.nq, g1.nv, g1.nu, len(g1.body_names)) == (36, 35, 29, 30)
    assert [g1.model.joint(i).name for i in range(1, g1.model.njnt)] == ORDER
    assert [g1.model.actuator(u).name for u in range(g1.nu)] == ORDER
    assert g1.hinge.tolist() == [[7 + u, u] for u in range(29)]
    np.testing.assert_allclose(g1.kd, 0.05 * g1.kp)
    assert [g1.body_names[b] for b in g1.bodies("feet")] == ["left_ankle_roll_link", "right_ankle_roll_link"]


def test_forward_kinematics_are_the_robots(g1, source):
    rng, ours, theirs = np.random.default_rng(0), mujoco.MjData(g1.model), mujoco.MjData(source)
    low, high = source.jnt_range[1:].T
    for _ in range(50):
        qpos = np.concatenate([rng.normal(size=7), rng.uniform(low, high)])
        mujoco.mj_normalizeQuat(source, qpos)
        ours.qpos[:], theirs.qpos[:] = qpos, qpos
        mujoco.mj_kinematics(g1.model, ours)
        mujoco.mj_kinematics(source, theirs)
        for name in g1.body_names:
            np.testing.assert_allclose(ours.body(name).xpos, theirs.body(name).xpos, atol=2e-5, err_msg=name)
            np.testing.assert_allclose(ours.body(name).xmat, theirs.body(name).xmat, atol=1e-6, err_msg=name)


def test_masses_and_limits_are_the_robots(g1, source):
    assert g1.model.body_mass.sum() == pytest.approx(source.body_mass.sum(), abs=1e-6)
    for name in g1.body_names:
        ours, theirs = g1.model.body(name), source.body(name)
        assert ours.mass[0] == pytest.approx(theirs.mass[0], rel=1e-6), name
        np.testing.assert_allclose(ours.ipos, theirs.ipos, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(ours.inertia, theirs.inertia, rtol=2e-3, atol=1e-8, err_msg=name)
    for u, name in enumerate(ORDER):
        joint, actuator = source.joint(name), source.actuator(name)
        np.testing.assert_allclose(g1.model.joint(name).range, joint.range, err_msg=name)
        np.testing.assert_allclose(g1.model.joint(name).axis, joint.axis, err_msg=name)
        np.testing.assert_allclose(g1.model.joint(name).armature, joint.armature, rtol=1e-5, err_msg=name)
        assert g1.torque[u] == actuator.forcerange[1], name


def test_stands_on_level_soles(g1):
    qpos, data = g1.stand(), mujoco.MjData(g1.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(g1.model, data)
    for foot in g1.bodies("feet"):
        assert data.xpos[foot + 1, 2] == pytest.approx(0.035, abs=1e-3)  # the sole is 35 mm below the ankle
        np.testing.assert_allclose(data.xmat[foot + 1].reshape(3, 3)[2], [0, 0, 1], atol=2e-3)
    low, high = g1.span(qpos)
    assert low == pytest.approx(0, abs=1e-9) and 1.25 < high < 1.35
    assert g1.span(g1.model.qpos0)[0] == pytest.approx(0, abs=2e-3)  # its rest pose stands too


def test_stands_under_pd(g1):
    """One second at 30 Hz; nothing but the PD controller holds it up."""
    sim = BatchSim(build_scene(g1, SceneConfig(control_hz=CONTROL_HZ)), 1, 1)
    qpos = g1.stand()[None]
    sim.set_state(np.array([0]), qpos, np.zeros((1, g1.nv)))
    for _ in range(CONTROL_HZ):
        assert len(sim.step(g1.pose_to_ctrl(qpos), SceneConfig().substeps)) == 0
    assert sim.qpos[0, 2] == pytest.approx(qpos[0, 2], abs=0.02)
    assert rotate(sim.qpos[0, 3:7], np.array([0, 0, 1.0]))[2] > 0.99
    assert np.abs(sim.qpos[0, 7:] - qpos[0, 7:]).max() < 0.1


def test_no_blow_up_under_wild_targets(g1):
    sim, rng = BatchSim(build_scene(g1, SceneConfig()), 32, 1), np.random.default_rng(0)
    sim.set_state(np.arange(32), np.tile(g1.stand(), (32, 1)), np.zeros((32, g1.nv)))
    for _ in range(30):
        assert len(sim.step(rng.normal(size=(32, g1.nu)), SceneConfig().substeps)) == 0
        assert np.abs(sim.qvel).max() < 100


def test_the_file_is_ours_alone(g1):
    assert not re.search(r"<mesh|<light|<option|\bfile=|plane", g1.xml)
    assert "BSD-3-Clause" in g1.xml and (g1.model.geom_contype == 0).all()
