"""mirror.py: a mirrored pose puts every body where its counterpart's mirror image is."""

import mujoco
import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.motion.character import Character, characters, from_mjcf
from kinetok.rotation import from_rotvec, multiply

# the right side's frames are turned, its hinge runs the other way round, has another zero, and there is a slide
ODD = """<mujoco><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 1"><freejoint/><geom size="0.1"/>
  <body name="tail" pos="-0.2 0 0"><joint name="wag" type="ball"/><geom size="0.05"/></body>
  <body name="l_arm" pos="0 0.2 0.1"><joint name="l_ball" type="ball"/><geom size="0.1"/>
    <body name="l_hand" pos="0.1 0.2 0.3"><joint name="l_slide" type="slide" axis="0 1 1"/>
      <joint name="l_hinge" axis="1 2 3" pos="0 0.01 0"/><geom size="0.1"/></body>
  </body>
  <body name="r_arm" pos="0 -0.2 0.1" quat="0 0 0 1"><joint name="r_ball" type="ball"/><geom size="0.1"/>
    <body name="r_hand" pos="-0.1 0.2 0.3"><joint name="r_slide" type="slide" axis="0 1 1" ref="0.1"/>
      <joint name="r_hinge" axis="-1 2 3" pos="0 0.01 0" ref="0.4"/><geom size="0.1"/></body>
  </body></body></worldbody>
  <actuator><position joint="l_hinge" kp="1"/></actuator></mujoco>"""
ROLES = {"mirror": {"swap": {"l_arm": "r_arm", "l_hand": "r_hand"}, "plane": "xz"}}
SIGNS = np.outer([1, -1, 1], [1, -1, 1])  # M R M, M = diag(1, -1, 1)


def swapped(name: str) -> str:
    for a, b in (("left_", "right_"), ("right_", "left_"), ("l_", "r_"), ("r_", "l_")):
        if name.startswith(a):
            return b + name.removeprefix(a)
    return name


def poses(body: Character, count: int) -> np.ndarray:
    qpos = np.random.default_rng(0).normal(size=(count, body.nq))
    for row in qpos:
        mujoco.mj_normalizeQuat(body.model, row)
    return qpos


def since_rest(data: mujoco.MjData, rest: mujoco.MjData, body: str) -> np.ndarray:
    return data.body(body).xmat.reshape(3, 3) @ rest.body(body).xmat.reshape(3, 3).T


@pytest.mark.parametrize("name", [*characters(), "odd"])
def test_bodies_are_mirror_images(name):
    body = from_mjcf("odd", ODD, ROLES) if name == "odd" else Character.load(name)
    qpos = poses(body, 30)
    mirrored = body.mirror_qpos(qpos)
    here, there, rest = (mujoco.MjData(body.model) for _ in range(3))
    mujoco.mj_kinematics(body.model, rest)
    for pose, image in zip(qpos, mirrored, strict=True):
        here.qpos[:], there.qpos[:] = pose, image
        mujoco.mj_kinematics(body.model, here)
        mujoco.mj_kinematics(body.model, there)
        for b in body.body_names:
            expected = here.body(b).xpos * [1, -1, 1]
            np.testing.assert_allclose(there.body(swapped(b)).xpos, expected, atol=1e-9, err_msg=b)
            turned, image_turned = since_rest(here, rest, b), since_rest(there, rest, swapped(b))
            np.testing.assert_allclose(image_turned, turned * SIGNS, atol=1e-9, err_msg=b)
    np.testing.assert_allclose(body.mirror_qpos(mirrored), qpos, atol=1e-12)  # twice is once not


def test_a_standing_pose_is_its_own_image():
    for name in characters():
        body = Character.load(name)
        np.testing.assert_allclose(body.mirror_qpos(body.stand()), body.stand(), atol=1e-12)


def test_shapes_and_types(humanoid):
    qpos = poses(humanoid, 6).astype(np.float32)
    mirrored = humanoid.mirror_qpos(qpos.reshape(2, 3, -1))
    assert mirrored.dtype == np.float32 and mirrored.shape == (2, 3, humanoid.nq)
    np.testing.assert_array_equal(mirrored[1, 2], humanoid.mirror_qpos(qpos[5]))


def test_planes_of_the_root(humanoid):
    """The same character with its trunk's frame turned about z: its sides part at the root's yz plane."""
    turn, back = from_rotvec(np.array([0, 0, np.pi / 2])), from_rotvec(np.array([0, 0, -np.pi / 2]))
    spec = mujoco.MjSpec.from_string(ODD)
    for child in spec.body("trunk").bodies:
        x, y, z = child.pos
        child.pos, child.quat = [y, -x, z], multiply(back, child.quat)
    roles = {"mirror": ROLES["mirror"] | {"plane": "yz"}}
    plain, turned = from_mjcf("odd", ODD, ROLES), from_mjcf("turned", spec.to_xml(), roles)
    pose = poses(plain, 1)[0]
    same = np.concatenate([pose[:3], multiply(pose[3:7], turn), pose[7:]])
    expected, found = plain.mirror_qpos(pose), turned.mirror_qpos(same)
    expected[3:7] = multiply(expected[3:7], turn)
    np.testing.assert_allclose(found[[0, 1, 2]], expected[:3])
    assert abs(found[3:7] @ expected[3:7]) == pytest.approx(1)  # q and -q are one rotation
    np.testing.assert_allclose(found[7:], expected[7:], atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('pos="0 -0.2 0.1"', 'pos="0 -0.2 0.11"', "at rest the body 'r_arm' is at .* not the mirror image of 'l_arm'"),
        ('axis="-1 2 3"', 'axis="-1 2 2"', "the joints 'l_hinge' and 'r_hinge' are not mirror images"),
        ('<joint name="r_ball" type="ball"/>', "", "the bodies 'l_arm' and 'r_arm' have unlike joints"),
    ],
)
def test_characters_that_are_not_symmetric(old, new, message):
    assert old in ODD
    with pytest.raises(ConfigError, match=f"character 'odd': .*{message}"):
        body = from_mjcf("odd", ODD.replace(old, new), ROLES)
        body.mirror_qpos(body.model.qpos0)


def test_without_the_role(tiny):
    with pytest.raises(ConfigError, match=r"character 'tiny' names no 'mirror'.*to its roles file"):
        tiny.mirror_qpos(tiny.model.qpos0)
