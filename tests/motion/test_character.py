"""character.py: the built-in humanoid against its source, PD targets against MuJoCo, messages."""

import json

import mujoco
import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.motion.character import Character, from_mjcf

# joint id of the source file -> our body; its hands are bodies without a joint of their own
BODIES = (
    "pelvis", "chest", "head", "right_thigh", "right_shin", "right_foot", "right_upper_arm", "right_lower_arm",
    "right_hand", "left_thigh", "left_shin", "left_foot", "left_upper_arm", "left_lower_arm", "left_hand",
)  # fmt: skip
GAINS = {"chest": 1000, "neck": 100, "hip": 500, "knee": 500, "ankle": 400, "shoulder": 400, "elbow": 300}


def test_humanoid_sizes(humanoid):
    assert (len(humanoid.body_names), humanoid.nq, humanoid.nv, humanoid.nu) == (15, 43, 34, 28)
    assert humanoid.model.body_mass.sum() == pytest.approx(45.0)
    assert set(humanoid.body_names) == set(BODIES)
    assert humanoid.parents[0] == -1 and all(p < i for i, p in enumerate(humanoid.parents))
    assert Character.load("humanoid") is humanoid


def test_humanoid_matches_its_source(humanoid, data_dir):
    source = json.loads((data_dir / "train" / "characters" / "humanoid3d.txt").read_text())
    masses = {BODIES[body["ID"]]: body["Mass"] for body in source["BodyDefs"]}
    model = humanoid.model
    for name, mass in masses.items():
        assert model.body(name).mass[0] == pytest.approx(mass), name
    for joint in source["Skeleton"]["Joints"][1:]:  # y up to z up: x = x, y = -z, z = y
        offset = [joint["AttachX"], -joint["AttachZ"], joint["AttachY"]]
        body = model.body(BODIES[joint["ID"]])
        np.testing.assert_allclose(body.pos, offset, atol=1e-9, err_msg=joint["Name"])
        assert model.body(body.parentid[0]).name == BODIES[joint["Parent"]]
        if joint.get("TorqueLim"):
            limits = [
                humanoid.torque[u]
                for u in range(humanoid.nu)
                if model.jnt_bodyid[model.actuator_trnid[u, 0]] == body.id
            ]
            np.testing.assert_allclose(limits, 1.5 * joint["TorqueLim"], err_msg=joint["Name"])


def test_humanoid_gains(humanoid):
    for u in range(humanoid.nu):
        joint = humanoid.model.joint(humanoid.model.actuator_trnid[u, 0]).name
        assert humanoid.kp[u] == GAINS[joint.removeprefix("left_").removeprefix("right_")], joint
    np.testing.assert_allclose(humanoid.kd, 0.05 * humanoid.kp)


def test_gains_of_a_tiny_character(tiny):
    np.testing.assert_allclose(tiny.kp, [30, 30, 30, 20])
    np.testing.assert_allclose(tiny.kd, [3, 3, 3, 1 + 2])  # joint damping plus the actuator's kv
    np.testing.assert_allclose(tiny.torque, [5, 5, 5, np.inf])
    assert tiny.dof.tolist() == [6, 7, 8, 9]
    assert (tiny.ball.tolist(), tiny.hinge.tolist()) == ([[7, 0]], [[11, 3]])
    assert (tiny.body_names, tiny.parents) == (("base", "arm", "hand"), (-1, 0, 1))


@pytest.mark.parametrize("name", ["humanoid", "tiny"])
def test_pose_to_ctrl_is_mujocos_actuator_length(name, request):
    body = request.getfixturevalue(name)
    rng, data = np.random.default_rng(0), mujoco.MjData(body.model)
    poses = rng.normal(size=(20, body.nq))
    for qpos in poses:
        mujoco.mj_normalizeQuat(body.model, qpos)
        data.qpos[:] = qpos
        mujoco.mj_forward(body.model, data)
        np.testing.assert_allclose(body.pose_to_ctrl(qpos), data.actuator_length, atol=1e-10)
    assert body.pose_to_ctrl(poses.reshape(4, 5, -1)).shape == (4, 5, body.nu)


def test_roles(humanoid, tiny):
    assert [humanoid.body_names[i] for i in humanoid.bodies("feet")] == ["right_foot", "left_foot"]
    assert tiny.bodies("head") == [0]
    with pytest.raises(ConfigError, match=r"character 'tiny' names no 'feet'; roles known: \['hands', 'head'\]"):
        tiny.bodies("feet")


def mjcf(joint: str, actuator: str) -> str:
    return f"""<mujoco><worldbody><body name="a">{joint}<geom size="0.1"/>
      <body name="b"><joint name="j"/><geom size="0.1"/></body></body></worldbody>
      <actuator>{actuator}</actuator></mujoco>"""


@pytest.mark.parametrize(
    ("joint", "actuator", "message"),
    [
        ("", '<position joint="j" kp="1"/>', "character 'c': the first joint must be a free joint"),
        ('<joint type="slide"/>', '<position joint="j" kp="1"/>', "the first joint must be a free joint"),
        ("<freejoint/>", "", "character 'c': no actuators; add <position> actuators"),
        ("<freejoint/>", '<motor name="m" joint="j"/>', "character 'c': actuator 'm' is not a <position> actuator"),
    ],
)
def test_what_an_mjcf_lacks(joint, actuator, message):
    with pytest.raises(ConfigError, match=message):
        from_mjcf("c", mjcf(joint, actuator), {})


def test_load_from_a_path_with_roles_beside_it(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(mjcf("<freejoint/>", '<position joint="j" kp="7"/>'))
    path.with_suffix(".json").write_text('{"hands": ["b"]}')
    robot = Character.load(str(path))
    assert (robot.name, robot.kp.tolist(), robot.bodies("hands")) == ("robot", [7.0], [1])


def test_load_messages(tmp_path):
    with pytest.raises(ConfigError, match=r"unknown character 'humanoit'.*path of an MJCF file ending in \.xml"):
        Character.load("humanoit")
    with pytest.raises(FileNotFoundError, match=r"none\.xml: no such MJCF file"):
        Character.load(str(tmp_path / "none.xml"))
