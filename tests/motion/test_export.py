"""export.py: a clip of a character becomes a skeleton that stands and moves as its bodies do, its own or SMPL's; the
commands that write them."""

import numpy as np
import pytest
from click.testing import CliRunner, Result

from kinetok import rotation
from kinetok.cli import main
from kinetok.config import ConfigError
from kinetok.motion.character import Character, from_mjcf
from kinetok.motion.clip import Clip
from kinetok.motion.export import ANKLE, skeleton_motion, smpl_motion
from kinetok.motion.formats import read_amass, read_bvh, read_robot_csv, write_amass, write_bvh
from kinetok.motion.kinematics import kinematics, lowest_point
from kinetok.motion.library import ClipLibrary
from kinetok.motion.retarget import retarget
from kinetok.motion.retarget.body import measure
from kinetok.motion.skeleton import SkeletonMotion
from kinetok.motion.smpl import OFFSETS, PARENTS

OFF_CENTRE = """
<mujoco model="off">
  <worldbody>
    <body name="base" quat="0.6 0 0 0.8">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3"/>
      <body name="arm" pos="0.1 0 0.5" quat="0.8 0.6 0 0">
        <joint name="elbow" type="{kind}" axis="0 1 0" pos="0.02 0.03 -0.2"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="0.05"/>
        <body name="hand" pos="0 0 1"><geom type="sphere" size="0.1"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="20"/></actuator>
</mujoco>
"""


def test_the_joints_of_the_humanoid_are_its_bodies(humanoid, walk):
    motion = skeleton_motion(humanoid, walk)
    assert (motion.joints, motion.parents, motion.fps) == (humanoid.body_names, humanoid.parents, walk.fps)
    bodies = kinematics(humanoid, walk.qpos, walk.fps)
    positions, rotations = motion.pose()
    np.testing.assert_allclose(positions, bodies.xpos, atol=1e-9)
    rest = kinematics(humanoid, humanoid.model.qpos0[None].repeat(2, 0), 1.0)
    expected = rotation.multiply(bodies.xquat, rotation.conjugate(rest.xquat[:1]))
    np.testing.assert_allclose(rotation.to_matrix(rotations), rotation.to_matrix(expected), atol=1e-9)


def test_all_rotations_are_zero_in_the_reference_pose(humanoid):
    still = Clip(name="still", character="humanoid", fps=30.0, qpos=humanoid.model.qpos0[None].repeat(2, 0))
    motion = skeleton_motion(humanoid, still)
    np.testing.assert_allclose(rotation.to_rotvec(motion.local), 0, atol=1e-9)


def test_the_walk_survives_a_bvh_file(humanoid, walk, tmp_path):
    motion = skeleton_motion(humanoid, walk)
    write_bvh(tmp_path / "walk.bvh", motion)
    again = read_bvh(tmp_path / "walk.bvh")
    assert (again.unit, again.fps) == ("cm", pytest.approx(walk.fps, rel=1e-9))
    order = [again.joints.index(name) for name in motion.joints]
    np.testing.assert_allclose(again.pose()[0][:, order], motion.pose()[0], atol=1e-5)


def clip_of(path, kind: str) -> tuple[Character, Clip]:
    path.write_text(OFF_CENTRE.format(kind=kind))
    body = Character.load(str(path))
    qpos = np.tile(body.model.qpos0, (5, 1))
    qpos[:, 7] = np.linspace(0, 0.8, 5)
    return body, Clip(name="bend", character=str(path), fps=10.0, qpos=qpos)


def test_a_joint_stands_where_its_axis_is(tmp_path):
    body, clip = clip_of(tmp_path / "off.xml", "hinge")
    motion = skeleton_motion(body, clip)
    poses = kinematics(body, clip.qpos, clip.fps)
    positions = motion.pose()[0]
    np.testing.assert_allclose(positions[:, 1], positions[:1, 1].repeat(5, 0), atol=1e-9)
    assert np.ptp(poses.xpos[:, 1], axis=0).max() > 0.05  # while the body's origin swings about it
    np.testing.assert_allclose(positions[:, 2], poses.xpos[:, 2], atol=1e-9)


def test_what_cannot_be_a_skeleton(tmp_path, walk, tiny):
    body, clip = clip_of(tmp_path / "slide.xml", "slide")
    with pytest.raises(ValueError, match=r"body 'arm' moves by 0\.8 m against its parent"):
        skeleton_motion(body, clip)
    with pytest.raises(ValueError, match=r"clip 'walk' has 43 columns; 'tiny' has 12"):
        skeleton_motion(tiny, walk)


def test_an_unnamed_body_is_no_bvh_joint(tmp_path):
    body = from_mjcf("off", OFF_CENTRE.format(kind="hinge").replace('<body name="hand"', "<body"), {})
    motion = SkeletonMotion(
        name="x", fps=1, joints=body.body_names, parents=body.parents, offsets=np.zeros((3, 3)),
        local=np.tile([1.0, 0, 0, 0], (2, 3, 1)), root=np.zeros((2, 3)),
    )  # fmt: skip
    with pytest.raises(ValueError, match="joint '' has a name that BVH cannot hold"):
        write_bvh(tmp_path / "x.bvh", motion)
    assert not list(tmp_path.iterdir())


BONES = {
    "thigh": ("shin", "hip", "knee"),
    "shin": ("foot", "knee", "ankle"),
    "upper_arm": ("lower_arm", "shoulder", "elbow"),
    "lower_arm": ("hand", "elbow", "wrist"),
}  # part: the next part, SMPL's joints at its ends


def bent(character: str, frames: int = 20, fps: float = 30.0) -> Clip:
    """A character walks on the spot, turns and leans: hinges and balls of hips, knees, arms and waist swing."""
    body = Character.load(character)
    swing = np.sin(np.linspace(0, 2 * np.pi, frames))
    qpos = np.tile(body.stand(), (frames, 1))
    for column in body.ball[:, 0]:
        turn = rotation.from_rotvec(swing[:, None] * [0.1, -0.2, 0.15])
        qpos[:, column : column + 4] = rotation.multiply(turn, qpos[:, column : column + 4])
    for number, column in enumerate(body.hinge[:, 0]):
        qpos[:, column] += 0.15 * (-1) ** number * swing + 0.1 * (character == "humanoid")
    qpos[:, 3:7] = rotation.multiply(
        rotation.about_z(0.7 + swing), rotation.from_rotvec(swing[:, None] * [0.1, 0.2, 0])
    )
    qpos[:, 2] -= lowest_point(body, qpos)
    return Clip(name="bent", character=character, fps=fps, qpos=qpos)


def through_a_file(path, clip: Clip) -> SkeletonMotion:
    write_amass(path, smpl_motion(Character.load(clip.character), clip))
    return read_amass(path)


def joints_of(motion: SkeletonMotion) -> dict[str, np.ndarray]:
    return dict(zip(motion.joints, motion.pose()[0].swapaxes(0, 1), strict=True))


@pytest.mark.parametrize("character", ["humanoid", "g1"])
def test_bones_of_smpl_point_where_the_characters_do(character, tmp_path):
    clip, body = bent(character), Character.load(character)
    motion, figure = through_a_file(tmp_path / "x.npz", clip), measure(body)
    joints, moved = joints_of(motion), kinematics(body, clip.qpos, clip.fps)

    def centre(part: str) -> np.ndarray:
        at = figure.bodies[part]
        return moved.xpos[:, at] + rotation.rotate(moved.xquat[:, at], figure.centre[part])

    for side in ("left", "right"):
        for part, (following, upper, lower) in BONES.items():
            ours = centre(f"{side}_{following}") - centre(f"{side}_{part}")
            theirs = joints[f"{side}_{lower}"] - joints[f"{side}_{upper}"]
            cross = np.linalg.norm(np.cross(ours, theirs), axis=-1)
            assert np.arctan2(cross, (ours * theirs).sum(-1)).max() < 1e-6


@pytest.mark.parametrize("character", ["humanoid", "g1"])
def test_who_stands_also_stands_as_smpl(character, tmp_path):
    body = Character.load(character)
    still = Clip(name="still", character=character, fps=30.0, qpos=body.stand()[None].repeat(2, 0))
    motion = through_a_file(tmp_path / "x.npz", still)
    assert (motion.parents, motion.fps) == (PARENTS, 30.0)
    np.testing.assert_array_equal(motion.offsets, OFFSETS)
    place = {name: points[0] for name, points in joints_of(motion).items()}
    for name, point in place.items():
        image = place[name.replace("left", "x").replace("right", "left").replace("x", "right")]
        np.testing.assert_allclose(point, image * [1, -1, 1], atol=1e-3)
    assert place["left_ankle"][2] == pytest.approx(ANKLE, abs=0.005)
    assert place["left_foot"] - place["left_ankle"] == pytest.approx([0.13, 0.02, -0.06], abs=1e-6)  # ahead is x
    assert place["left_wrist"][1] > 0.15 and place["left_wrist"][2] < place["left_elbow"][2] < place["left_shoulder"][2]
    assert place["head"][2] - place["pelvis"][2] == pytest.approx(0.6, abs=1e-6)


def test_a_bend_is_shared_by_the_spine_and_by_the_neck(humanoid):
    qpos = humanoid.stand()[None].repeat(2, 0)
    for joint, angle in (("chest", [0, 0.6, 0]), ("neck", [0, 0, 0.4])):
        column = int(humanoid.model.joint(joint).qposadr[0])
        qpos[1, column : column + 4] = rotation.from_rotvec(np.array(angle))
    motion = smpl_motion(humanoid, Clip(name="x", character="humanoid", fps=30.0, qpos=qpos))
    angle = np.linalg.norm(rotation.to_rotvec(motion.local[1]), axis=-1)
    angles = dict(zip(motion.joints, angle, strict=True))
    for name, wanted in (("spine1", 0.2), ("spine2", 0.2), ("spine3", 0.2), ("neck", 0.2), ("head", 0.2)):
        assert angles[name] == pytest.approx(wanted, abs=1e-6)
    assert angles["left_collar"] == pytest.approx(0, abs=1e-6)
    assert [angles["left_elbow"], angles["right_elbow"]] == pytest.approx([0.2, 0.2], abs=1e-6)


def test_an_upper_arm_carries_its_turn_about_itself(humanoid):
    """Elbows at a right angle; the left upper arm then turns by 0.7 about itself, which moves only the forearm."""
    qpos = humanoid.stand()[None].repeat(2, 0)
    qpos[:, int(humanoid.model.joint("left_elbow").qposadr[0])] = np.pi / 2
    clip = Clip(name="x", character="humanoid", fps=30.0, qpos=qpos)
    joints = joints_of(smpl_motion(humanoid, clip))
    along = (joints["left_elbow"] - joints["left_shoulder"])[0]
    turn = rotation.from_rotvec(0.7 * along / np.linalg.norm(along))
    column = int(humanoid.model.joint("left_shoulder").qposadr[0])
    body = kinematics(humanoid, qpos, 30.0).xquat[0, humanoid.parts["left_upper_arm"]]
    inside = rotation.multiply(rotation.multiply(rotation.conjugate(body), turn), body)
    qpos[1, column : column + 4] = rotation.multiply(qpos[1, column : column + 4], inside)
    motion = smpl_motion(humanoid, clip)
    turned = motion.pose()[1][:, motion.joints.index("left_shoulder")]
    between = rotation.multiply(turned[1], rotation.conjugate(turned[0]))
    np.testing.assert_allclose(rotation.to_rotvec(between), rotation.to_rotvec(turn), atol=1e-9)
    forearm = joints_of(motion)["left_wrist"] - joints_of(motion)["left_elbow"]
    np.testing.assert_allclose(rotation.rotate(turn, forearm[0]), forearm[1], atol=1e-9)


@pytest.mark.parametrize(("character", "mean", "most"), [("humanoid", 0.012, 0.06), ("g1", 0.02, 0.08)])
def test_the_motion_comes_back_by_retargeting(character, mean, most, tmp_path):
    pytest.importorskip("mink")
    clip, body = bent(character), Character.load(character)
    again = retarget(through_a_file(tmp_path / "x.npz", clip), character).clip
    ours, theirs = (kinematics(body, qpos, 30.0).xpos for qpos in (clip.qpos, again.qpos))
    apart = np.linalg.norm(ours - theirs, axis=-1)
    assert apart.mean() < mean and apart.max() < most


def test_the_walk_comes_back_through_smpl(humanoid, walk, tmp_path):
    pytest.importorskip("mink")
    result = retarget(through_a_file(tmp_path / "x.npz", walk), "humanoid", fps=None)
    ours, theirs = (kinematics(humanoid, qpos, walk.fps).xpos for qpos in (walk.qpos, result.clip.qpos))
    apart = np.linalg.norm((ours - ours[:, :1]) - (theirs - theirs[:, :1]), axis=-1)
    assert apart.mean() < 0.005 and apart.max() < 0.06  # the most at feet, which are put level on the floor
    assert result.report.skate < 0.02 and result.report.residual_mean < 0.01


def test_what_cannot_be_smpl(tiny, walk):
    clip = Clip(name="x", character="g1", fps=30.0, qpos=Character.load("g1").stand()[None].repeat(2, 0))
    with pytest.raises(ValueError, match=r"clip 'x' has 36 columns; 'humanoid' has 43"):
        smpl_motion(Character.load("humanoid"), clip)


def test_a_character_without_parts_is_no_smpl(tmp_path):
    body, clip = clip_of(tmp_path / "off.xml", "hinge")
    with pytest.raises(ConfigError, match="no body is named for pelvis, left_thigh"):
        smpl_motion(body, clip)


# -- commands


def kinetok(*args: object) -> Result:
    return CliRunner().invoke(main, [str(arg) for arg in args])


def test_a_clip_is_exported_by_suffix(tmp_path):
    clip = bent("g1", frames=51, fps=50.0)
    ClipLibrary.write(tmp_path / "in.safetensors", [clip])
    outs = {suffix: tmp_path / "new" / f"out.{suffix}" for suffix in ("bvh", "csv", "npz")}
    for suffix, out in outs.items():
        told = "31 frames at 30 fps" if suffix == "csv" else "51 frames at 50 fps"
        assert kinetok("clips", "export", tmp_path / "in.safetensors", "--out", out).output == f"wrote {out}: {told}\n"
    assert set(read_bvh(outs["bvh"]).joints) == set(Character.load("g1").body_names)
    assert read_amass(outs["npz"]).family == "smpl"
    np.testing.assert_allclose(read_robot_csv(outs["csv"]).qpos[15, 7:], clip.qpos[25, 7:], atol=1e-4)


def test_the_humanoid_is_no_robot(tmp_path):
    ClipLibrary.write(tmp_path / "in.safetensors", [bent("humanoid")])
    result = kinetok("clips", "export", tmp_path / "in.safetensors", "--out", tmp_path / "new" / "out.csv")
    assert result.exit_code == 1 and result.output.startswith("Error: ") and "humanoid" in result.output
    assert not (tmp_path / "new").exists()


def test_tokens_are_decoded_for_other_programs(tmp_path):
    ClipLibrary.write(tmp_path / "in.safetensors", [bent("humanoid")])
    tokens = tmp_path / "tokens.safetensors"
    fsq = ("--tokenizer", "humanoid-fsq", "--out")
    encoded = kinetok("tokenize", "encode", tmp_path / "in.safetensors", *fsq, tokens)
    assert encoded.exit_code == 0, encoded.output
    for suffix, read in (("bvh", read_bvh), ("npz", read_amass)):
        out = tmp_path / f"out.{suffix}"
        result = kinetok("tokenize", "decode", tokens, *fsq, out)
        assert result.exit_code == 0, result.output
        motion = read(out)
        assert f"wrote {out}: {len(motion.root)} frames at 30 fps" in result.output
        assert motion.joints[0] == "pelvis" and len(motion.root) > 5


def test_a_robot_in_a_bvh_comes_back(data_dir, tmp_path):
    walk = read_robot_csv(data_dir / "g1" / "kimodo_wxyz" / "kimodo_walk.csv")
    write_bvh(tmp_path / "walk.bvh", skeleton_motion(Character.load("g1"), walk))
    motion = read_bvh(tmp_path / "walk.bvh")
    back = retarget(motion, "g1")
    assert back.report.rig == "family unitree, joint by joint" and abs(back.report.scale - 1) < 1e-4
    assert np.abs(back.clip.qpos[:, 7:] - walk.qpos[: len(back.clip.qpos), 7:]).max() < 1e-4
    assert np.abs(back.clip.qpos[:, :3] - walk.qpos[: len(back.clip.qpos), :3]).max() < 0.05
    solved = retarget(motion, "g1", direct=False)
    assert solved.report.residual_mean < 0.01
    assert np.abs(solved.clip.qpos[:, :3] - walk.qpos[: len(back.clip.qpos), :3]).max() < 0.1
