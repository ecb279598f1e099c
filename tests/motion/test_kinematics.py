"""kinematics.py against one MjData per frame, and by hand."""

import mujoco
import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.character import from_mjcf
from kinetok.motion.kinematics import kinematics, lowest_point, velocities


def test_against_one_simulation_per_frame(walk, humanoid):
    motion = kinematics(humanoid, walk.qpos, walk.fps)
    data, six = mujoco.MjData(humanoid.model), np.zeros(6)
    for t in range(0, len(walk.qpos), 5):
        data.qpos[:], data.qvel[:] = walk.qpos[t], motion.qvel[t]
        mujoco.mj_forward(humanoid.model, data)
        np.testing.assert_array_equal(motion.xpos[t], data.xpos[1:])
        np.testing.assert_array_equal(motion.xquat[t], data.xquat[1:])
        for b in range(1, humanoid.model.nbody):
            mujoco.mj_objectVelocity(humanoid.model, data, mujoco.mjtObj.mjOBJ_XBODY, b, six, 0)
            np.testing.assert_allclose(motion.angular[t, b - 1], six[:3], atol=1e-9)
            np.testing.assert_allclose(motion.linear[t, b - 1], six[3:], atol=1e-9)


def test_constant_speeds_are_exact(tiny):
    t = np.arange(30) / 25.0
    qpos = np.tile(tiny.model.qpos0, (30, 1))
    qpos[:, :3] = np.outer(t, [1.0, -2.0, 0.5])
    qpos[:, 3:7] = rotation.about_z(0.7 * t)
    qpos[:, 7:11] = rotation.from_rotvec(np.outer(t, [0.3, 0.0, 0.4]))
    qpos[:, 11] = 1.5 * t
    expected = [1.0, -2.0, 0.5, 0, 0, 0.7, 0.3, 0.0, 0.4, 1.5]
    np.testing.assert_allclose(velocities(tiny, qpos, 25.0), np.tile(expected, (30, 1)), atol=1e-9)
    np.testing.assert_allclose(kinematics(tiny, qpos, 25.0).linear[:, 0], np.tile([1.0, -2.0, 0.5], (30, 1)), atol=1e-9)


def test_linear_velocities_are_differences_of_positions(walk, humanoid):
    motion = kinematics(humanoid, walk.resample(240.0).qpos, 240.0)
    differences = (motion.xpos[2:] - motion.xpos[:-2]) * 120.0
    # clip knots are corners: compare where the path is smooth, at most frames
    assert np.percentile(np.linalg.norm(differences - motion.linear[1:-1], axis=-1), 80) < 0.02


BASE = '<mujoco><worldbody><body name="a"><freejoint/>{}</body></worldbody>{}</mujoco>'
ARM = '<body name="b"><joint name="j"/><geom size="0.001" mass="1"/></body>'
ACTUATOR = '<actuator><position joint="j" kp="1"/></actuator>'
LYING = rotation.from_rotvec(np.array([np.pi / 2, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("geom", "quat", "height"),
    [
        ('<geom type="sphere" size="0.2"/>', [1, 0, 0, 0], 0.8),
        ('<geom type="capsule" size="0.1 0.3"/>', [1, 0, 0, 0], 1 - 0.3 - 0.1),
        ('<geom type="capsule" size="0.1 0.3"/>', LYING, 1 - 0.1),
        ('<geom type="box" size="0.1 0.2 0.3"/>', [1, 0, 0, 0], 1 - 0.3),
        ('<geom type="box" size="0.1 0.2 0.3"/>', LYING, 1 - 0.2),
        ('<geom type="box" size="0.1 0.1 0.1" pos="0 0 -0.5"/>', [1, 0, 0, 0], 1 - 0.6),
        ('<geom type="cylinder" size="0.1 0.3"/>', [1, 0, 0, 0], 1 - 0.3),
    ],
)
def test_lowest_point_by_hand(geom, quat, height):
    body = from_mjcf("b", BASE.format(geom + ARM, ACTUATOR), {})
    qpos = np.concatenate([[3.0, 4.0, 1.0], quat, [0.0]])[None]
    np.testing.assert_allclose(lowest_point(body, qpos), [height], atol=1e-12)
