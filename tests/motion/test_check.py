"""check.py: planted defects are found where they are, mended where one repair is right, and clean motion passes."""

from dataclasses import replace

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.check import check, mend, report
from kinetok.motion.clip import Clip
from kinetok.motion.formats import read, read_clips
from kinetok.motion.kinematics import lowest_point
from kinetok.motion.skeleton import SkeletonMotion

JOINTS = ("hips", "spine", "head", "left_thigh", "left_foot", "right_thigh", "right_foot")
OFFSETS = [[0, 0, 0], [0, 0, 0.3], [0, 0, 0.4], [0, 0.1, 0], [0, 0, -0.85], [0, -0.1, 0], [0, 0, -0.85]]


def person(frames: int = 120, fps: float = 60.0) -> SkeletonMotion:
    """A body of 1.55 m that walks along x at 1 m/s and swings spine and thighs at up to 3 rad/s."""
    t = np.arange(frames) / fps
    local = np.tile([1.0, 0.0, 0.0, 0.0], (frames, len(JOINTS), 1))
    for joint, sign in ((1, 0.3), (3, 1.0), (5, -1.0)):
        local[:, joint] = rotation.from_rotvec(np.outer(0.5 * sign * np.sin(6 * t) + 0.4, [0, 1, 0]))
    root = np.stack([t, 0 * t, np.full(frames, 0.9)], axis=1)
    parents = (-1, 0, 1, 0, 3, 0, 5)
    return SkeletonMotion(
        name="p", fps=fps, joints=JOINTS, parents=parents, offsets=np.array(OFFSETS), local=local, root=root
    )


def turned(motion, frames, joint: int, angle: float):
    local = motion.local.copy()
    local[frames, joint] = rotation.multiply(local[frames, joint], rotation.from_rotvec(np.array([0.0, angle, 0.0])))
    return replace(motion, local=local)


def kinds(findings) -> list[tuple]:
    return [(f.severity, f.kind, f.frame, f.joint) for f in findings]


def test_a_clean_motion_is_left_alone(walk):
    for motion in (person(), walk):
        same, findings = mend(motion)
        assert same is motion and findings == []
    assert report([]) == "nothing to say: the motion is clean"


def test_a_lone_spike_is_laid_between_its_neighbours(walk, humanoid):
    clean = person()
    fixed, findings = mend(turned(clean, 50, 3, 0.8))
    assert kinds(findings) == [("fixed", "spike", 50, "left_thigh")]
    np.testing.assert_allclose(fixed.local, clean.local, atol=5e-3)
    assert check(fixed) == []
    qpos, elbow = walk.qpos.copy(), int(humanoid.model.joint("right_elbow").qposadr[0])
    qpos[20, elbow] += 1.5
    fixed, findings = mend(replace(walk, qpos=qpos))
    assert kinds(findings) == [("fixed", "spike", 20, "right_elbow")]
    np.testing.assert_allclose(fixed.qpos, walk.qpos, atol=0.05)


def test_a_jump_that_stays_is_refused_with_its_place():
    motion = turned(person(), slice(50, None), 5, 1.0)
    same, findings = mend(motion)
    assert kinds(findings) == [("refused", "jump", 50, "right_thigh")] and same is motion
    assert findings[0].value == pytest.approx(60, abs=4)
    assert "refused jump     frame 50, joint right_thigh: turns" in report(findings)
    (small,) = check(turned(person(), slice(50, None), 5, 0.5))
    assert (small.severity, small.frame) == ("note", 50)


def test_two_bad_frames_have_no_one_repair():
    found = check(turned(person(), [50, 51], 3, 0.9))
    assert kinds(found) == [("refused", "jump", 50, "left_thigh"), ("refused", "jump", 52, "left_thigh")]


def test_a_joint_that_whirls_is_refused():
    motion, local = person(), person().local.copy()
    local[40:60, 1] = rotation.from_rotvec(np.outer(np.arange(20) * 0.9, [0, 0, 1]))
    found = [f for f in check(replace(motion, local=local)) if f.kind == "fast"]
    assert [f.joint for f in found] == ["spine"] and 40 <= (found[0].frame or 0) <= 60


def test_fast_but_honest_motion_passes(data_dir):
    for name in ("backflip", "spinkick", "roll", "cartwheel"):
        (clip,) = read_clips(data_dir / "train" / "deepmimic" / f"humanoid3d_{name}.txt")
        assert check(clip) == [], name


def test_a_root_that_leaps_is_refused():
    root = person().root.copy()
    root[70:, 0] += 2.0
    assert kinds(check(replace(person(), root=root))) == [("refused", "jump", 70, "root position")]


def test_a_rest_pose_before_the_motion_is_dropped():
    motion = person()
    local, rest = motion.local.copy(), np.array([1.0, 0.0, 0.0, 0.0])
    local = rotation.multiply(local, rotation.from_rotvec(np.array([1.2, 0, 0.0])))  # far from rest
    one = local.copy()
    one[0] = rest
    fixed, findings = mend(replace(motion, local=one))
    assert (findings[0].kind, findings[0].severity, findings[0].value) == ("lead-in", "fixed", 1)
    np.testing.assert_array_equal(fixed.local[0], one[1])
    held = local.copy()
    held[:4] = rest
    assert len(mend(replace(motion, local=held))[0].root) == len(motion.root) - 4
    # what comes later keeps the frame numbers of the motion as given
    found = check(turned(replace(motion, local=one), slice(80, None), 1, 1.0))
    assert kinds(found)[1] == ("refused", "jump", 80, "spine")


def test_lead_ins_of_the_converters(data_dir):
    for name, frames in (("cmu_daz/cmu_09_01", 6), ("cmu_daz/cmu_11_01", 6), ("cmu_motionbuilder/cmu_12_01_walk", 1)):
        (motion,) = read(data_dir / "bvh" / f"{name}.bvh")
        fixed, findings = mend(motion)
        lead = [f.value for f in findings if f.kind == "lead-in"]
        assert lead in ([frames], []), name  # none where the reader dropped it already
        assert not [f for f in check(fixed) if f.severity != "note"], name


def test_real_dirty_frames(data_dir):
    (motion,) = read(data_dir / "g1" / "g1_moves" / "M_Move10.csv", fps=60)
    refused = [f for f in check(motion) if f.severity == "refused"]
    assert [(f.frame, f.joint) for f in refused] == [(1224, "right_shoulder_pitch_joint")]


@pytest.mark.parametrize("unit", [100.0, 1000.0, 1 / 0.0254, 0.01])
def test_a_body_in_another_unit_is_scaled(unit):
    motion = person()
    giant = replace(motion, offsets=motion.offsets * unit, root=motion.root * unit)
    fixed, findings = mend(giant)
    assert [f.kind for f in findings if f.severity == "fixed"] == ["units"]
    np.testing.assert_allclose(fixed.root, motion.root, rtol=1e-9)
    assert not [f for f in findings if f.severity == "refused"]


def test_sizes_of_no_unit_are_refused(walk):
    motion = person()
    odd = replace(motion, offsets=motion.offsets * 5, root=motion.root * 5)
    assert [f.kind for f in check(odd) if f.severity == "refused"] == ["units"]
    qpos = walk.qpos.copy()
    qpos[:, :3] *= 100
    found = [f for f in check(replace(walk, qpos=qpos)) if f.kind == "units"]
    assert [(f.severity, f.joint) for f in found] == [("refused", "root position")]


def test_a_wrong_vertical_is_refused(walk):
    motion, over = person(), rotation.from_rotvec(np.array([-np.pi / 2, 0, 0]))  # z to y
    local = motion.local.copy()
    local[:, 0] = rotation.multiply(np.tile(over, (len(local), 1)), local[:, 0])
    lying = replace(motion, local=local, root=rotation.rotate(np.tile(over, (len(local), 1)), motion.root))
    (finding,) = [f for f in check(lying) if f.severity == "refused"]
    assert finding.kind == "up" and "y is up in the file" in finding.message
    qpos, upside = walk.qpos.copy(), rotation.from_rotvec(np.array([np.pi, 0, 0]))
    qpos[:, 3:7] = rotation.multiply(np.tile(upside, (len(qpos), 1)), qpos[:, 3:7])
    qpos[:, 1:3] *= -1
    assert "points down" in next(f for f in check(replace(walk, qpos=qpos)) if f.kind == "up").message


def test_crawling_and_lying_are_no_wrong_vertical(data_dir):
    for name in ("crawl", "getup_facedown", "getup_faceup"):
        (clip,) = read_clips(data_dir / "train" / "deepmimic" / f"humanoid3d_{name}.txt")
        assert check(clip) == []
        lying = clip.slice(0.0, 0.6)
        assert [f for f in check(lying) if f.kind == "up"] == []


def lifted(walk: Clip, height) -> Clip:
    qpos = walk.qpos.copy()
    qpos[:, 2] += height
    return replace(walk, qpos=qpos, loop=False)


def test_a_constant_height_is_taken_out_and_a_drift_is_not(walk, humanoid):
    for height in (-0.2, 0.06, 0.5):
        fixed, findings = mend(lifted(walk, height))
        assert kinds(findings) == [("fixed", "floor", None, None)] and findings[0].value == pytest.approx(
            height, abs=0.02
        )
        assert abs(np.percentile(lowest_point(humanoid, fixed.qpos), 5)) < 0.02
    long = walk.resample(walk.fps)
    qpos = long.at(np.arange(300) / 30)
    drifting = lifted(replace(long, qpos=qpos), np.linspace(0, 0.4, 300))
    same, findings = mend(drifting)
    assert same is drifting and kinds(findings)[0][:2] == ("note", "floor")
    assert "drifts by +4.0 cm/s" in findings[0].message


def test_signs_and_full_turns_are_aligned(walk, humanoid):
    motion, local = person(), person().local.copy()
    local[30:45, 3] *= -1
    fixed, findings = mend(replace(motion, local=local))
    assert kinds(findings) == [("fixed", "sign", 30, "left_thigh")]
    np.testing.assert_array_equal(fixed.local, motion.local)
    qpos, elbow = walk.qpos.copy(), int(humanoid.model.joint("left_elbow").qposadr[0])
    qpos[10:, elbow] += 2 * np.pi
    fixed, findings = mend(replace(walk, qpos=qpos))
    assert kinds(findings) == [("fixed", "sign", 10, "left_elbow")]
    np.testing.assert_allclose(fixed.qpos, walk.qpos, atol=1e-12)


def test_a_knee_that_bends_the_wrong_way_is_refused():
    body = Character.load("g1")
    qpos = np.tile(body.stand(), (60, 1))
    qpos[:, 0] = np.linspace(0, 0.5, 60)
    clip = Clip(name="g1", character="g1", fps=30.0, qpos=qpos)
    assert not [f for f in check(clip) if f.kind == "limit"]
    knee = body.model.joint("left_knee_joint").qposadr[0]
    low = body.model.joint("left_knee_joint").range[0]
    for beyond, severity in ((0.03, None), (0.2, "note"), (1.0, "refused")):
        qpos[20:35, knee] = low - 0.9 * beyond
        qpos[30, knee] = low - beyond
        found = [f for f in check(clip) if f.kind == "limit"]
        expected = [(severity, "limit", 30, "left_knee_joint")] if severity else []
        assert kinds(found) == expected and all("beyond its range of -0.09 to +2.88" in f.message for f in found)


def test_frames_that_stand_still_are_noted():
    motion = person()
    local, root = motion.local.copy(), motion.root.copy()
    local[40:70], root[40:70] = local[40], root[40]
    found = [f for f in check(replace(motion, local=local, root=root)) if f.kind == "frozen"]
    assert [(f.severity, f.frame) for f in found] == [("note", 40)] and found[0].value == pytest.approx(29 / 60)


@pytest.mark.parametrize("frames", [2, 3, 4, 9])
def test_very_short_motions(walk, frames):
    whole = person(frames)
    single = replace(whole, joints=("a",), parents=(-1,), offsets=np.zeros((1, 3)), local=whole.local[:, :1])
    assert check(whole) == [] and check(replace(walk, qpos=walk.qpos[:frames])) == []
    assert [(f.severity, f.kind) for f in check(single)] == [("refused", "units")]


def test_report_gathers_what_is_alike():
    text = report(check(turned(person(), [50, 51], 3, 0.9)))
    assert text.splitlines()[0].endswith("(also at 52)") or text.splitlines()[0].endswith("(also at 50)")
    assert text.splitlines()[-1] == "2 refused"
