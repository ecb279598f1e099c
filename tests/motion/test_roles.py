"""roles.py: what a roles file may say, and what each mistake in it is answered with."""

import json

import pytest

from kinetok.config import ConfigError
from kinetok.motion.character import Character, characters, from_mjcf
from kinetok.motion.roles import PARTS, read_roles

XML = """<mujoco><worldbody><body name="trunk"><freejoint/><geom size="0.1"/>
  <body name="l_arm" pos="0 0.2 0"><joint name="l_elbow" axis="0 1 0"/><geom size="0.1"/></body>
  <body name="r_arm" pos="0 -0.2 0"><joint name="r_elbow" type="ball"/><geom size="0.1"/></body></body></worldbody>
  <actuator><position joint="l_elbow" kp="1"/></actuator></mujoco>"""
SWAP = {"swap": "l_ <-> r_", "plane": "xz"}


def test_a_full_file_is_read(tmp_path):
    (tmp_path / "robot.xml").write_text(XML)
    roles = {"hands": ["l_arm", "r_arm"], "sword": "r_arm", "mirror": SWAP, "retarget": {"left_hand": "l_arm"}}
    roles["stand"] = {"l_elbow": 0.5, "r_elbow": [0, 0.1, 0]}
    (tmp_path / "robot.json").write_text(json.dumps(roles))
    robot = Character.load(str(tmp_path / "robot.xml"))
    assert (robot.bodies("sword"), robot.parts, robot.part("left_wrist")) == ([2], {"left_hand": 1}, 1)
    assert robot.stand()[7] == 0.5 and robot.stand()[8:12] == pytest.approx([0.99875, 0, 0.04998, 0], abs=1e-5)
    assert robot.stand()[2] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("roles", "message"),
    [
        ({"feet": ["l_arn"]}, r"f\.json: 'feet' names the body 'l_arn'; the MJCF has: trunk, l_arm, r_arm; did"),
        ({"head": 3}, r"f\.json: 'head': expected the name of a body or a list of names, not 3"),
        ({"hands": [["l_arm"]]}, r"'hands' names the body \['l_arm'\]"),
        ({"retarget": {"left_hnd": "l_arm"}}, "names the part 'left_hnd'; one of: pelvis.*did you mean 'left_hand'"),
        ({"retarget": {"left_hand": "arm"}}, "'retarget' 'left_hand' names the body 'arm'"),
        ({"retarget": []}, r"'retarget': expected an object, not \[\]"),
        ({"stand": {"l_elbw": 1}}, "'stand' names the joint 'l_elbw'; the MJCF has: l_elbow, r_elbow; did you mean"),
        ({"stand": {"l_elbow": [1, 2, 3]}}, "'l_elbow' is .*; the joint needs a number, in radians"),
        ({"stand": {"r_elbow": 1}}, "'r_elbow' is 1; the joint needs three numbers, its rotation vector"),
        ({"stand": {"l_elbow": float("nan")}}, "'l_elbow' is nan"),
        ({"mirror": "xz"}, "'mirror': expected an object, not 'xz'"),
        ({"mirror": {"swap": "l_ <-> r_"}}, "'mirror': expected .*not {'swap': 'l_ <-> r_'}"),
        ({"mirror": {"swap": "l_ <-> r_", "plane": "zz"}}, "one of yz, xz, xy"),
        ({"mirror": {"swap": "l_ r_", "plane": "xz"}}, "'swap' is 'l_ r_'; write it as"),
        ({"mirror": {"swap": "l_ <-> q_", "plane": "xz"}}, "makes 'q_arm' of the body 'l_arm'.*did you mean 'r_arm'"),
        ({"mirror": {"swap": {"l_arm": "arm"}, "plane": "xz"}}, "'mirror' names the body 'arm'"),
        ({"mirror": {"swap": {"l_arm": "r_arm", "trunk": "r_arm"}, "plane": "xz"}}, "a body stands twice"),
    ],
)
def test_mistakes(roles, message):
    with pytest.raises(ConfigError, match=message):
        from_mjcf("robot", XML, roles, "f.json")


def test_files_that_are_no_roles(tmp_path):
    for text, message in (('{"feet": [', r"robot\.json: not JSON: .*line 1"), ("[1]", "expected an object such as")):
        (tmp_path / "robot.json").write_text(text)
        with pytest.raises(ConfigError, match=message):
            read_roles(tmp_path / "robot.json")
    (tmp_path / "robot.json").write_bytes(b"\xff\xfe{")
    with pytest.raises(ConfigError, match=r"robot\.json: not JSON"):
        read_roles(tmp_path / "robot.json")
    (tmp_path / "robot.xml").write_text(XML)
    (tmp_path / "robot.json").write_text('{"feet": ["foot"]}')
    with pytest.raises(ConfigError, match=r"robot\.json: 'feet' names the body 'foot'"):
        Character.load(str(tmp_path / "robot.xml"))


def test_parts(humanoid, tiny):
    assert [part for part in PARTS if part not in humanoid.parts] == ["left_toe", "right_toe"]
    assert all(humanoid.body_names[body] == part for part, body in humanoid.parts.items())
    assert humanoid.part("right_knee") == humanoid.part("right_shin") == humanoid.body_names.index("right_shin")
    with pytest.raises(ConfigError, match=r"unknown part 'left_thing'; one of: pelvis.*did you mean 'left_thigh'"):
        humanoid.part("left_thing")
    with pytest.raises(
        ConfigError, match=r"character 'tiny': no body is named for 'left_shin'; named: none; add .*; bodies: base, arm"
    ):
        tiny.part("left_knee")


@pytest.mark.parametrize("name", characters())
def test_built_in_roles_name_both_sides(name):
    body = Character.load(name)
    assert {"feet", "hands", "head", "mirror", "retarget", "stand"} <= set(body.roles)
    for part, index in body.parts.items():
        if part.startswith("left_"):
            other = body.parts[part.replace("left_", "right_")]
            assert body.body_names[other] == body.body_names[index].replace("left_", "right_")
