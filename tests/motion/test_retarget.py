"""Retargeting: a character's own motion comes back, rigs are told by their names, real files stand and do not skate."""

import json
import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from kinetok import rotation
from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.motion.check import mend
from kinetok.motion.clip import Clip
from kinetok.motion.export import skeleton_motion
from kinetok.motion.formats import read
from kinetok.motion.kinematics import kinematics, lowest_point
from kinetok.motion.retarget import retarget
from kinetok.motion.retarget.body import measure
from kinetok.motion.retarget.direct import copy_joints
from kinetok.motion.retarget.report import beyond_limits
from kinetok.motion.retarget.targets import bend, envelope
from kinetok.motion.rigs import REQUIRED, RigError, find_rig
from kinetok.motion.skeleton import SkeletonMotion

FPS = 30.0


def skeleton(clip: Clip) -> SkeletonMotion:
    """The clip's own character as a foreign skeleton: one joint per body, offsets and rotations from the model."""
    body = Character.load(clip.character)
    motion = kinematics(body, clip.qpos, clip.fps)
    local = motion.xquat.copy()
    for b, parent in enumerate(body.parents):
        if parent >= 0:
            local[:, b] = rotation.multiply(rotation.conjugate(motion.xquat[:, parent]), motion.xquat[:, b])
    # bodies that are turned at rest (raised arms) are written as a rest pose that is not turned
    return SkeletonMotion(
        name=clip.name,
        fps=clip.fps,
        joints=body.body_names,
        parents=body.parents,
        offsets=body.model.body_pos[1:].copy(),
        local=local,
        root=motion.xpos[:, 0],
    )


def made(frames: int = 30, *, lift: float = 0.0) -> Clip:
    """The humanoid bends its knees and swings its arms; its level feet stay in place, `lift` metres up in mid-clip."""
    body = Character.load("humanoid")
    t = np.linspace(0, 1, frames)
    qpos = np.tile(body.model.qpos0, (frames, 1))
    depth = 0.3 + 0.3 * np.sin(2 * np.pi * t)

    def put(joint: str, values: np.ndarray) -> None:
        at = int(body.model.joint(joint).qposadr[0])
        qpos[:, at : at + (values.shape[1] if values.ndim > 1 else 1)] = values.reshape(frames, -1)

    for side, sign in (("left", 1), ("right", -1)):
        put(f"{side}_hip", rotation.from_rotvec(np.outer(depth, [0, -1.0, 0])))
        put(f"{side}_knee", 2 * depth)
        put(f"{side}_ankle", rotation.from_rotvec(np.outer(depth, [0, -1.0, 0])))
        swing = np.stack([-sign * (0.9 + 0 * t), 0.8 * np.sin(2 * np.pi * t), 0.2 * t], axis=1)
        put(f"{side}_shoulder", rotation.from_rotvec(swing))
        put(f"{side}_elbow", 0.6 + 0.4 * np.cos(2 * np.pi * t))
    put("chest", rotation.from_rotvec(np.outer(np.sin(2 * np.pi * t), [0.1, 0.2, 0.1])))
    foot = kinematics(body, qpos, FPS).xpos[:, body.body_names.index("left_foot")]
    qpos[:, [0, 2]] -= foot[:, [0, 2]]
    qpos[:, 2] += lift * np.sin(np.pi * t) ** 2 - lowest_point(body, qpos)[0]
    return Clip(name="made", character="humanoid", fps=FPS, qpos=qpos)


def reframed(motion: SkeletonMotion, turns: np.ndarray) -> SkeletonMotion:
    """The same motion with each joint's frame turned by a constant: another zero pose, other numbers."""
    parents = np.array(motion.parents)
    above = rotation.conjugate(np.concatenate([[[1.0, 0, 0, 0]], turns[parents[1:]]]))
    local = rotation.multiply(rotation.multiply(np.broadcast_to(above, motion.local.shape), motion.local), turns)
    return replace(motion, local=local, offsets=rotation.rotate(above, motion.offsets))


def apart(qpos: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distances (T, B) between the bodies of two sequences of the humanoid's poses."""
    body = Character.load("humanoid")
    return np.linalg.norm(kinematics(body, qpos, FPS).xpos - kinematics(body, other, FPS).xpos, axis=-1)


def test_its_own_motion_comes_back():
    clip = made()
    result = retarget(skeleton(clip), "humanoid", direct=False)
    assert apart(result.clip.qpos, clip.qpos).max() < 1e-3
    report = result.report
    assert report.residual_max < 1e-3 and report.skate < 1e-3 and report.penetration_max < 1e-6
    assert report.contact == 1 and report.violations == 0 and report.scale == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("zero", ["its body frames unturned", "its reference pose"])
def test_angles_of_its_own_skeleton_are_copied(zero):
    clip = made(lift=0.4)
    body = Character.load("humanoid")
    motion = skeleton(clip) if zero.startswith("its body") else skeleton_motion(body, clip)
    large = replace(motion, offsets=2 * motion.offsets, root=2 * motion.root)
    result = retarget(large, "humanoid")
    assert result.report.rig.endswith("joint by joint") and result.report.scale == pytest.approx(0.5)
    assert np.abs(result.clip.qpos[:, 7:] - clip.qpos[:, 7:]).max() < 1e-6
    assert np.abs(result.clip.qpos[:, :7] - clip.qpos[:, :7]).max() < 0.02  # it is put on the floor, which takes a cm
    assert result.report.residual_max < 1e-6 and result.report.violations == 0


def test_angles_are_not_copied_where_skeletons_differ():
    motion, knee = skeleton(made()), 10
    assert motion.joints[knee] == "right_shin"
    longer = replace(motion, offsets=motion.offsets * np.where(np.arange(15) == knee, 1.1, 1)[:, None])
    local = motion.local.copy()
    local[:, knee] = rotation.multiply(local[:, knee], rotation.from_rotvec(np.tile([0.0, 0, 0.2], (len(local), 1))))
    aside = replace(motion, local=local)  # a knee that is twisted as well as bent
    elsewhere = replace(
        motion, parents=(*motion.parents[:12], 9, *motion.parents[13:])
    )  # a leg that hangs on the other
    rig, figure = find_rig(motion), measure(Character.load("humanoid"))
    assert copy_joints(motion, rig, figure)
    for other in (longer, aside, elsewhere):
        assert copy_joints(other, rig, figure) is None
    assert retarget(longer, "humanoid").report.rig == "family amp"


def test_feet_that_leave_the_ground_are_let_go():
    clip = made(lift=0.4)
    result = retarget(skeleton(clip), "humanoid", direct=False)
    gap = apart(result.clip.qpos, clip.qpos)
    assert gap.max() < 0.04 and np.median(gap) < 0.005  # take-off and landing are partly taken for standing
    assert 0.1 < result.report.contact < 0.4


def test_a_recorded_walk_comes_back(walk):
    result = retarget(skeleton(walk), "humanoid", fps=None, direct=False)
    assert np.median(apart(result.clip.qpos, walk.qpos)) < 0.012  # feet are pinned and levelled, the rest follows
    assert result.report.residual_mean < 0.01


def test_another_zero_pose_of_the_arms_changes_nothing():
    motion = skeleton(made())
    turns = np.tile([1.0, 0, 0, 0], (len(motion.joints), 1))
    for name in ("left_upper_arm", "right_upper_arm", "left_lower_arm", "left_hand"):
        turns[motion.joints.index(name)] = rotation.from_rotvec(np.array([0.9, -0.4, 0.7]))
    one, other = retarget(motion, "humanoid", direct=False), retarget(reframed(motion, turns), "humanoid")
    assert one.report.calibration == other.report.calibration == "rest"
    assert apart(one.clip.qpos, other.clip.qpos).max() < 1e-4


def test_a_zero_pose_without_sense_is_calibrated_by_the_motion():
    clip = made()
    turns = rotation.normalize(np.random.default_rng(0).normal(size=(15, 4)))
    result = retarget(reframed(skeleton(clip), turns), "humanoid")
    assert result.report.calibration == "motion"
    gap = apart(result.clip.qpos, clip.qpos)
    assert gap.mean() < 0.03 and gap.max() < 0.1


def test_scale_and_rate():
    motion = skeleton(made())
    large = replace(motion, offsets=2 * motion.offsets, root=2 * motion.root, fps=60.0)
    result = retarget(large, "humanoid", fps=20.0, direct=False)
    assert result.report.scale == pytest.approx(0.5, abs=1e-6)
    assert result.clip.fps == 20.0 and len(result.clip.qpos) == int(large.seconds * 20 + 1e-6) + 1
    assert retarget(large, "humanoid", fps=None).clip.fps == 60.0
    assert lowest_point(Character.load("humanoid"), result.clip.qpos).min() > -1e-6


def test_a_robot_stands_within_its_limits():
    result = retarget(skeleton(made()), "g1")
    robot, report = Character.load("g1"), result.report
    assert beyond_limits(robot.model, result.clip.qpos).max() == 0
    assert report.residual_mean < 0.02 and report.skate < 0.03 and report.penetration_max < 1e-6
    assert np.abs(lowest_point(robot, result.clip.qpos)).max() < 0.01
    knee = result.clip.qpos[:, robot.model.joint("left_knee_joint").qposadr[0]]
    assert knee.max() - knee.min() > 0.8  # of the 1.2 rad it bends in the original


def test_the_report_is_json():
    report = retarget(skeleton(made(12)), "humanoid", direct=False).report
    assert json.loads(json.dumps(report.to_json()))["frames"] == 12


def test_limits_of_hinges_and_balls(tiny):
    qpos = np.tile(tiny.model.qpos0, (2, 1))
    qpos[1, 7:11] = rotation.from_rotvec(np.array([0, 0.8, 0.0]))
    qpos[1, 11] = -0.7
    model = mujoco.MjModel.from_xml_string(
        tiny.xml.replace('type="ball"', 'type="ball" limited="true" range="0 0.5"').replace(
            'axis="0 1 0"', 'axis="0 1 0" limited="true" range="-0.6 1"'
        ).replace("<mujoco", "<mujoco", 1).replace("<worldbody>", '<compiler angle="radian"/><worldbody>', 1)
    )  # fmt: skip
    np.testing.assert_allclose(beyond_limits(model, qpos), [[0, 0, 0], [0, 0.3, 0.1]], atol=1e-9)


# -- geometry by hand


def test_two_bones_reach_for_their_end():
    start, end = np.zeros((2, 3)), np.array([[0, 0, -5.0], [0, 0, -9.0]])
    middle, reached = bend(start, end, np.array([[0, 1.0, 0]] * 2), 3.0, 4.0)
    # 3-4-5: cos = (9 + 25 - 16) / 30 = 0.6; a knee that flexes about +y lies ahead, at +x
    np.testing.assert_allclose(middle[0], [3 * 0.8, 0, -3 * 0.6], atol=1e-9)
    np.testing.assert_allclose(reached, [[0, 0, -5], [0, 0, -7]], atol=1e-9)


def test_an_envelope_is_above_and_smooth():
    need = np.zeros(60)
    need[30] = 1.0
    curve = envelope(need, 30.0)
    assert (curve >= need - 1e-12).all() and curve[30] == pytest.approx(1)
    assert np.abs(np.diff(curve)).max() < 0.5 and curve[[0, -1]].max() == 0


def test_hinges_in_a_row_are_one_joint():
    robot = measure(Character.load("g1"))
    # hip pitch axis 0.103 m below the pelvis, roll axis 0.133; ankle pitch axis 0.300 from the knee, roll 0.0176 more
    assert -0.14 < robot.offset["left_thigh"][2] + robot.centre["pelvis"][2] < -0.1
    assert robot.length["left_shin"] == pytest.approx(0.3 + 0.0176 / 2, abs=1e-3)
    assert robot.length["left_thigh"] == pytest.approx(robot.length["right_thigh"], abs=1e-6)


# -- whose rig

SPELLINGS = {
    "mixamorig:{Side}{Limb}": ("Left", "UpLeg Leg Foot Arm ForeArm Hand"),
    "{s}_{Limb}": ("L", "Hip Knee Ankle Shoulder Elbow Wrist"),
    "Bip01 {s} {Limb}": ("L", "Thigh Calf Foot UpperArm Forearm Hand"),
    "{limb}_{l}": ("l", "thigh calf foot upperarm lowerarm hand"),
    "{l}{limb}": ("l", "femur tibia foot humerus radius wrist"),
}


@pytest.mark.parametrize("pattern", SPELLINGS)
def test_names_tell_the_parts(pattern):
    motion = skeleton(made(3))
    words, joints = SPELLINGS[pattern][1].split(), list(motion.joints)
    for side in ("left", "right"):
        for part, word in zip(("thigh", "shin", "foot", "upper_arm", "lower_arm", "hand"), words, strict=True):
            spelled = pattern.format(Side=side.title(), Limb=word, limb=word, s=side[0].upper(), l=side[0])
            joints[joints.index(f"{side}_{part}")] = spelled
    rig = find_rig(replace(motion, joints=tuple(joints)))
    assert rig.how == "names"
    assert {part: motion.joints[joint] for part, joint in rig.parts.items()} == {
        name: name for name in motion.joints
    }  # fmt: skip


def test_neighbours_are_not_taken_for_limbs():
    names = {"left_thigh": "LeftHip", "left_shin": "LeftKnee", "left_foot": "LeftAnkle", "left_hand": "LeftWrist"}
    names |= {"left_upper_arm": "LeftShoulder", "left_lower_arm": "LeftElbow"}
    names |= {part.replace("left", "right"): name.replace("Left", "Right") for part, name in names.items()}
    motion = skeleton(made(3))
    joints = [names.get(name, name) for name in motion.joints]
    rig = find_rig(replace(motion, joints=tuple(joints)))
    assert joints[rig.parts["left_thigh"]] == "LeftHip" and joints[rig.parts["left_upper_arm"]] == "LeftShoulder"
    # the same words in a rig that calls the collar bone a shoulder
    arm, head = joints.index("LeftShoulder"), joints.index("head")
    joints[arm], joints[head] = "LeftArm", "LeftShoulder"
    rig = find_rig(replace(motion, joints=tuple(joints)))
    assert joints[rig.parts["left_upper_arm"]] == "LeftArm" and "head" not in rig.parts


def test_given_parts_win():
    motion = skeleton(made(3))
    joints = tuple(name.replace("left_thigh", "Oberschenkel") for name in motion.joints)
    motion = replace(motion, joints=joints)
    rig = find_rig(motion, {"left_thigh": "Oberschenkel"})
    assert rig.how == "given" and joints[rig.parts["left_thigh"]] == "Oberschenkel"
    assert retarget(motion, "humanoid", parts={"left_thigh": "Oberschenkel"}).report.rig == "given, joint by joint"


@pytest.mark.parametrize(
    ("renamed", "parts", "message"),
    [
        ("left_shin", None, r"cannot tell which joints are left_shin; the skeleton has pelvis.*parts=\{'left_shin'"),
        ("", {"left_knie": "left_shin"}, r"'left_knie' is no part of a body; parts are pelvis"),
        ("", {"left_shin": "knee"}, r"no joint 'knee'; the skeleton has pelvis"),
        ("", {"left_shin": "right_shin"}, r"left_shin is joint 'right_shin', which is not below 'left_thigh'"),
    ],
)
def test_rigs_that_are_refused(renamed, parts, message):
    motion = skeleton(made(3))
    joints = tuple("x1" if name == renamed else name for name in motion.joints)
    with pytest.raises(RigError, match=message):
        find_rig(replace(motion, joints=joints), parts)


def test_what_else_is_refused(tiny, tmp_path, monkeypatch):
    motion = skeleton(made(3))
    path = tmp_path / "tiny.xml"
    path.write_text(tiny.xml)
    with pytest.raises(ConfigError, match=f"no body is named for {', '.join(REQUIRED)}"):
        retarget(motion, str(path))
    with pytest.raises(ValueError, match=r"fps is 0.*must be positive"):
        retarget(motion, "humanoid", fps=0)
    with pytest.raises(ValueError, match="fewer than two frames at 1 fps"):
        retarget(motion, "humanoid", fps=1)
    monkeypatch.setitem(sys.modules, "mink", None)
    assert retarget(motion, "humanoid").clip.fps == FPS  # its own skeleton needs no solver
    with pytest.raises(ImportError, match=r"pip install 'kinetok\[retarget\]'"):
        retarget(motion, "humanoid", direct=False)


# -- real files

RECORDED = {
    "bvh/cmu_daz/cmu_09_01.bvh": "cmu-daz",
    "bvh/cmu_motionbuilder/cmu_12_01_walk.bvh": "cmu-motionbuilder",
    "bvh/cmu_max/jumping_jacks.bvh": "cmu-3dsmax",
    "bvh/fair1/jumping.bvh": "fair1",
    "bvh/snu_mass/walk.bvh": "snu-mass",
    "bvh/pymo/AV_8Walk_Meredith_HVHA_Rep1.bvh": "pymo",
    "amc/01_01_first600.amc": "cmu-asf",
    "smpl/synthetic_run_09_01_poses.npz": "smpl",
    "train/amp_npy/amp_humanoid_run.npy": "amp",
}


@pytest.mark.parametrize("file", RECORDED)
def test_recorded_files(data_dir, file):
    (recorded,) = read(data_dir / file)
    motion, _ = mend(recorded)
    assert isinstance(motion, SkeletonMotion)
    short = replace(motion, root=motion.root[: int(1.5 * motion.fps)], local=motion.local[: int(1.5 * motion.fps)])
    result = retarget(short, "humanoid", direct=False)
    report = result.report
    assert find_rig(short).how == f"family {RECORDED[file]}" and report.calibration == "rest"
    assert report.residual_mean < 0.012 and report.residual_max < 0.12
    assert report.skate < 0.06 and report.penetration_max < 1e-6 and report.violations == 0
    assert 0.9 < report.scale < 1.15 and report.contact > 0.2
    body = Character.load("humanoid")
    pelvis, head = body.body_names.index("pelvis"), body.body_names.index("head")
    moved = kinematics(body, result.clip.qpos, result.clip.fps)
    assert 0.6 < np.median(moved.xpos[:, pelvis, 2]) < 1.0 and (moved.xpos[:, head, 2] > moved.xpos[:, pelvis, 2]).all()
    # knees point where the body goes: ahead of the line from hip to ankle, seen in the pelvis
    ahead = rotation.rotate(moved.xquat[:, pelvis], np.broadcast_to([1.0, 0, 0], (len(moved.xquat), 3)))
    for side in ("left", "right"):
        hip, knee, ankle = (
            moved.xpos[:, body.body_names.index(f"{side}_{part}")] for part in ("thigh", "shin", "foot")
        )
        assert ((knee - (hip + ankle) / 2) * ahead).sum(-1).min() > -0.06


@pytest.mark.parametrize(
    "file",
    [
        "bvh/cmu_motionbuilder/cmu_12_01_walk.bvh",
        "bvh/pymo/AV_8Walk_Meredith_HVHA_Rep1.bvh",
        "train/amp_npy/amp_humanoid_walk.npy",
    ],
)
def test_a_foot_that_stands_is_level_on_whatever_floor_was_recorded(data_dir, file):
    (recorded,) = read(data_dir / file)
    motion, _ = mend(recorded)
    assert isinstance(motion, SkeletonMotion)
    body = Character.load("humanoid")
    clip = retarget(motion, "humanoid", direct=False).clip
    moved = kinematics(body, clip.qpos, clip.fps)
    for foot in body.bodies("feet"):
        ahead = rotation.rotate(moved.xquat[:, foot], np.array([1.0, 0.0, 0.0]))
        standing = np.linalg.norm(moved.linear[:, foot], axis=-1) < 0.1
        pitch = np.degrees(np.arcsin(-ahead[standing, 2]))
        assert standing.sum() >= 10 and np.percentile(np.abs(pitch), 75) < 5, (file, pitch.round())
