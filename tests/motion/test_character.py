"""character.py: the built-in humanoid against its source, PD targets against MuJoCo, messages."""

import json
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.motion import character
from kinetok.motion.character import Character, characters, from_mjcf, read_mjcf
from kinetok.motion.formats import read_clips

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
        ("<freejoint/>", '<position name="p" joint="j" kp="1" gear="2"/>', "'p' has gear 2; PD targets are joint"),
        ('<freejoint name="f"/>', '<position name="p" joint="f" kp="1"/>', "actuator 'p' drives the root"),
        ("<freejoint/>", '<position name="p" body="b" kp="1"/>', "'c': MuJoCo cannot read its MJCF: XML Error"),
        ("<freejoint/>", '<adhesion name="p" body="b" ctrlrange="0 1"/>', "'c': actuator 'p' does not drive a joint"),
    ],
)
def test_what_an_mjcf_lacks(joint, actuator, message):
    with pytest.raises(ConfigError, match=message):
        from_mjcf("c", mjcf(joint, actuator), {})


GOOD = mjcf("<freejoint/>", '<position joint="j" kp="1"/>')


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<worldbody><geom name="ground" type="plane" size="1 1 1"/>', "has a geom .'ground'."),
        ("</worldbody>", '<body name="ball"/></worldbody>', "bodies 'a', 'ball' in the world; it must be one tree"),
        ("<worldbody>", '<worldbody><body name="c"/>', "the first joint must be a free joint"),
        ('<geom size="0.1"/>', '<geom size="0.1" contype="0" conaffinity="0"/>', "no geom collides with the floor"),
    ],
)
def test_what_a_world_may_not_hold(old, new, message):
    assert from_mjcf("c", GOOD, {}).nu == 1 and old in GOOD
    with pytest.raises(ConfigError, match=f"character 'c': .*{message}"):
        from_mjcf("c", GOOD.replace(old, new), {})


def test_torque_motors_with_gains_in_the_joint(data_dir):
    """The message says what the springs mean; converting is what docs/characters.md says."""
    path = data_dir / "g1" / "g1_primitives_boxfeet.xml"
    if not path.exists():
        pytest.skip("data/g1/g1_primitives_boxfeet.xml is absent")
    with pytest.raises(ConfigError, match=r"'left_hip_pitch_joint' is not a <position> .*stiffness 100 and damping 10"):
        Character.load(str(path))
    text = (Path(__file__).parents[2] / "docs" / "characters.md").read_text()
    snippet = text.split("```python\n# torque motors")[1].split("```")[0]
    scope = {"robot": path}
    exec("#" + snippet, scope)
    converted = from_mjcf("converted", scope["spec"].to_xml(), {})
    np.testing.assert_allclose(converted.kp[:6], [100, 100, 100, 200, 20, 20])
    np.testing.assert_allclose(converted.kd[:6], [10, 10, 10, 20, 2, 2])
    np.testing.assert_allclose(converted.torque[:6], [88, 88, 88, 139, 50, 50])
    assert not converted.model.jnt_stiffness.any()


def test_a_file_of_files_is_read_whole(tmp_path, monkeypatch):
    """Includes and meshes are found from anywhere, later too."""
    folder = tmp_path / "robot"
    (folder / "meshes").mkdir(parents=True)
    tetrahedron = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (folder / "meshes" / "foot.obj").write_text(tetrahedron)
    (folder / "drive.xml").write_text('<mujoco><actuator><position joint="j" kp="9"/></actuator></mujoco>')
    asset = '<compiler meshdir="meshes"/><asset><mesh name="m" file="foot.obj"/></asset>'
    text = GOOD.replace("<mujoco>", "<mujoco>" + asset)
    text = text.replace('<actuator><position joint="j" kp="1"/></actuator>', '<include file="drive.xml"/>')
    text = text.replace('<geom size="0.1"/>', '<geom type="mesh" mesh="m"/>')
    (folder / "robot.xml").write_text(text)
    monkeypatch.chdir(tmp_path)
    robot = Character.load("robot/robot.xml")
    monkeypatch.chdir(folder / "meshes")
    assert mujoco.MjModel.from_xml_string(robot.xml).nmesh == 1
    assert (robot.kp.tolist(), robot.span(robot.stand())[0]) == ([9.0], pytest.approx(0, abs=1e-6))
    (folder / "drive.xml").unlink()
    with pytest.raises(ConfigError, match=r"robot\.xml: MuJoCo cannot read it: .*drive\.xml"):
        read_mjcf(folder / "robot.xml")


def test_menagerie(tmp_path, monkeypatch):
    pytest.importorskip("mujoco_menagerie")
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("MENAGERIE_BASE_URL", (tmp_path / "nothing").as_uri())
    with pytest.raises(ConfigError, match=r"menagerie:unitree_g1: the download failed: .*; connect .* MENAGERIE_ROOT"):
        Character.load("menagerie:unitree_g1")
    with pytest.raises(ConfigError, match=r"Unknown robot 'unitree_g7'. Did you mean 'unitree_g1'"):
        Character.load("menagerie:unitree_g7")
    (tmp_path / "unitree_g1").mkdir()
    (tmp_path / "unitree_g1" / "g1.xml").write_text(GOOD)
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    assert Character.load("menagerie:unitree_g1").name == "g1"
    with pytest.raises(ConfigError, match="no entry point 'g2'; available: g1"):
        Character.load("menagerie:unitree_g1/g2")
    monkeypatch.setattr(character, "menagerie", None)
    with pytest.raises(ConfigError, match=r"menagerie:unitree_h1: .*: pip install mujoco-menagerie"):
        Character.load("menagerie:unitree_h1")


def test_standing_pose_and_span(humanoid, tiny):
    assert characters() == ["humanoid", "g1"]
    qpos = humanoid.stand()
    assert humanoid.span(qpos) == pytest.approx((0, 1.619), abs=1e-3)  # the head's sphere ends 1.6190 m up
    qpos[2] += 1.5
    assert humanoid.span(qpos) == pytest.approx((1.5, 3.119), abs=1e-3)
    assert tiny.span(tiny.stand()) == pytest.approx((0, 0.3 + 0.5 + 1.0 + 0.1))  # box, arm, hand
    qpos = tiny.stand()
    qpos[7:11] = np.sqrt(0.5), np.sqrt(0.5), 0, 0  # the arm horizontal
    assert tiny.span(qpos) == pytest.approx((0, 0.3 + 0.5 + 0.1))


def test_load_from_a_path_with_roles_beside_it(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(mjcf("<freejoint/>", '<position joint="j" kp="7"/>'))
    path.with_suffix(".json").write_text('{"hands": ["b"]}')
    robot = Character.load(str(path))
    assert (robot.name, robot.kp.tolist(), robot.bodies("hands")) == ("robot", [7.0], [1])


def test_a_g1_of_another_source_has_the_roles_of_the_built_in_one(data_dir, tmp_path, monkeypatch):
    pytest.importorskip("mujoco_menagerie")
    folder = tmp_path / "unitree_g1"
    shutil.copytree(data_dir / "g1" / "assets", folder / "assets")
    shutil.copyfile(data_dir / "g1" / "g1_capsules_pd.xml", folder / "g1.xml")  # with meshes, as the menagerie's is
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    Character.load.cache_clear()
    robot, known = Character.load("menagerie:unitree_g1"), Character.load("g1")
    assert robot.model.nmesh > 30 and robot.body_names == known.body_names and robot.roles == known.roles
    (clip,) = read_clips(data_dir / "bvh" / "cmu_motionbuilder" / "cmu_12_01_walk.bvh", "menagerie:unitree_g1")
    assert clip.character == "menagerie:unitree_g1" and robot.span(clip.qpos[40])[0] == pytest.approx(0, abs=0.03)
    (folder / "g1.json").write_text("{}")  # roles beside the file win
    Character.load.cache_clear()
    assert Character.load("menagerie:unitree_g1").roles == {}


def test_torque_limits_of_actuators_and_of_joints():
    def torque(joint: str, actuator: str) -> float:
        text = GOOD.replace('<joint name="j"', f'<joint name="j" {joint}').replace('kp="1"', f'kp="1" {actuator}')
        return from_mjcf("c", text, {}).torque[0]

    assert GOOD.count('<joint name="j"') == 1 and torque("", "") == np.inf
    assert torque("", 'forcerange="-9 9"') == 9 and torque('actuatorfrcrange="-7 7"', "") == 7
    assert torque('actuatorfrcrange="-7 7"', 'forcerange="-9 9"') == 7


def test_load_messages(tmp_path):
    with pytest.raises(ConfigError, match=r"unknown character 'humanoit'.*path of an MJCF file ending in \.xml"):
        Character.load("humanoit")
    with pytest.raises(FileNotFoundError, match=r"none\.xml: no such MJCF file"):
        Character.load(str(tmp_path / "none.xml"))
