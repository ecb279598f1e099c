"""formats/__init__.py: every collected file reads, formats are told apart, what is no motion is named or passed, and
what is read passes the gate."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.motion.clip import Clip
from kinetok.motion.formats import (
    FORMATS,
    FormatError,
    SkeletonMotion,
    draw_clips,
    each_clip,
    open_library,
    read,
    read_clips,
    write_amass,
    write_robot_csv,
)
from kinetok.motion.library import ClipLibrary
from tests.conftest import sway

# frames per second and frames of one file of every format in the collection, and whose body it is
COLLECTED = {
    "amc/backflip.amc": (120.0, 247, "cmu-asf"),
    "bvh/cmu_daz/cmu_02_01.bvh": (120.0, 344, "cmu-daz"),
    "bvh/fair1/dab.bvh": (30.0, 339, "fair1"),
    "g1/g1_moves/M_ShortMove15.csv": (30.0, 408, "g1"),
    "g1/kimodo_wxyz/kimodo_walk.csv": (30.0, 150, "g1"),
    "smpl/synthetic_run_09_01_poses.npz": (120.0, 143, "smpl"),
    "smpl/synthetic_walk_12_01_stageii.npz": (120.0, 523, "smpl"),
    "train/amp_npy/amp_humanoid_run.npy": (60.0, 82, "amp"),
    "train/deepmimic/humanoid3d_run.txt": (30.0, 25, "humanoid"),
}


def facts(motion: Clip | SkeletonMotion) -> tuple[float, int, str]:
    if isinstance(motion, Clip):
        return round(motion.fps, 2), len(motion.qpos), motion.character
    return round(motion.fps, 2), len(motion.root), motion.family


def test_every_format_of_the_collection(data_dir):
    for name, wanted in COLLECTED.items():
        (motion,) = read(data_dir / name)
        assert facts(motion) == wanted, name


def test_every_collected_file(data_dir):
    pytest.importorskip("mink")
    suffixes = {suffix for known in FORMATS for suffix in known.suffixes} - {".txt", ".json"}
    files = [path for path in data_dir.rglob("*") if path.suffix in suffixes]
    files += list(data_dir.glob("train/deepmimic*/*.txt"))
    assert len(files) == 77
    refused = []
    for path in files:
        (motion,) = read(path)
        assert facts(motion)[1] >= 2, path
        try:
            (clip,) = read_clips(path)  # what `kinetok clips import` does
        except FormatError as error:
            refused.append((path.name, str(error).partition(": ")[2]))
            continue
        assert np.isfinite(clip.qpos).all() and clip.seconds > 0.4, path
    # made by hand to try a parser: a chain of 0.12 m, and no limbs
    assert [name for name, _ in refused] == ["full_precision_frame_time.bvh", "rotation_first_root.bvh"], refused
    assert "the body is 0.12 m large" in refused[0][1] and "cannot tell which joints" in refused[1][1]


def test_a_folder_gives_what_is_motion_and_passes_the_rest(tmp_path, squat, data_dir):
    write_robot_csv(tmp_path / "b.csv", squat.clip())
    ClipLibrary.write(tmp_path / "a.safetensors", [squat.clip("one"), squat.clip("two")])
    (poses,) = read(data_dir / "smpl" / "synthetic_run_09_01_poses.npz")
    write_amass(tmp_path / "c_poses.npz", poses)
    np.savez(tmp_path / "shape.npz", betas=np.zeros(16))
    np.savez(tmp_path / "c_stagei.npz", poses=np.zeros((9, 156)), trans=np.zeros((9, 3)), mocap_framerate=9.0)
    np.savez(tmp_path / "weights.npz", layer=np.zeros(3))
    for name in ("LICENSE.txt", "notes.md", "notes.txt", "body.xml", "01.asf", "readme", "picture.png"):
        (tmp_path / name).write_text("hello")
    (tmp_path / "log.csv").write_text("step,loss\n1,2\n3,4\n")
    (tmp_path / "model.pkl").write_bytes(pickle.dumps({"weights": np.zeros(3)}))
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "folder.csv").mkdir()
    write_robot_csv(tmp_path / "folder.csv" / "deep.csv", squat.clip())
    names = [motion.name for motion in read(tmp_path)]
    assert names == ["one", "two", "b", "c_poses", "deep"]


@pytest.mark.parametrize(
    ("name", "content", "where", "reason"),
    [
        ("shape.npz", b"x", "file", "is no motion: it is the body shape of an AMASS subject"),
        ("male_stagei.npz", b"x", "file", "the motion is in the *_stageii.npz"),
        ("01.asf", b"x", "file", "the skeleton that .amc files refer to"),
        ("body.xml", b"x", "file", "a character, not a motion"),
        ("LICENSE.txt", b"x", "file", "a licence text"),
        ("README.md", b"x", "file", "a text"),
        (
            "walk.fbx",
            b"x",
            "first bytes",
            "unknown format; formats: DeepMimic .txt/.json, kinetok .safetensors, BVH .bvh",
        ),
        ("walk.pkl", pickle.dumps({"a": 1}), "first bytes", "unknown format"),
        ("walk.bvh", b"", "file", "is empty"),
        ("walk.csv", b"", "file", "is empty"),
        ("walk.csv", b"a,b\n1,2\n3,4\n", "line 1", "neither numbers nor BONES-SEED's names"),
        ("walk.npy", b"\x93NUMPY", "header", "not an npy array"),
        ("walk.npz", b"PK\x03\x04", "archive", "damaged or cut off"),
        ("walk.motion", b"PK\x03\x04", "archive", "damaged or cut off"),
    ],
)
def test_a_named_file_says_why_not(tmp_path, name, content, where, reason):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError) as caught:
        read(tmp_path / name)
    assert caught.value.where == where and reason in str(caught.value) and caught.value.path == tmp_path / name


def test_broken_files_of_a_folder_are_not_passed_over(tmp_path, squat):
    write_robot_csv(tmp_path / "a.csv", squat.clip())
    (tmp_path / "b.bvh").write_text("")
    with pytest.raises(FormatError, match=r"b\.bvh"):
        read(tmp_path)


def test_the_rate_of_files_that_name_none(tmp_path, squat):
    write_robot_csv(tmp_path / "a.csv", squat.clip())
    ClipLibrary.write(tmp_path / "b.safetensors", [squat.clip()])
    assert [motion.fps for motion in read(tmp_path, fps=60)] == [60, 30]
    assert [clip.fps for clip in read_clips(tmp_path)] == [30, 30]


def test_robot_clips_stay_with_the_robot_unless_another_body_is_asked_for(tmp_path, data_dir):
    pytest.importorskip("mink")
    robot, person = data_dir / "g1" / "kimodo_wxyz" / "kimodo_walk.csv", data_dir / "train" / "deepmimic"
    assert read_clips(robot)[0].character == read_clips(robot, "g1")[0].character == "g1"
    for path, character, upright in ((robot, "humanoid", 0.75), (person / "humanoid3d_walk.txt", "g1", 0.65)):
        (own,), (other,) = read_clips(path), read_clips(path, character)
        assert other.character == character and abs(other.seconds - own.seconds) < 0.05
        assert other.qpos[:, 2].min() > upright
        walked = [np.linalg.norm(clip.qpos[-1, :2] - clip.qpos[0, :2]) for clip in (own, other)]
        assert 0.6 < walked[1] / walked[0] < 1.7  # by the ratio of the legs


def test_skeletons_are_retargeted(data_dir):
    pytest.importorskip("mink")
    path = data_dir / "train" / "amp_npy" / "amp_humanoid_backflip.npy"
    for character in (None, "g1"):
        (clip,) = read_clips(path, character)
        assert clip.character == (character or "humanoid") and clip.name == "amp_humanoid_backflip"
        assert clip.seconds == pytest.approx(28 / 16, abs=0.04)


def test_a_skeleton_that_is_no_body(data_dir):
    path = data_dir / "bvh" / "edge" / "rotation_first_root.bvh"
    with pytest.raises(FormatError, match=r"rotation_first_root\.bvh: skeleton: .*cannot tell which joints are"):
        read_clips(path)


def test_what_has_one_right_repair_is_repaired_and_said(tmp_path, squat):
    raised = replace(squat.clip(), qpos=squat.clip().qpos + np.eye(36)[2] * 0.2)
    write_robot_csv(tmp_path / "high.csv", raised)
    said: list[str] = []
    (clip,) = read_clips(tmp_path / "high.csv", say=said.append)
    assert abs(clip.qpos[:, 2] - squat.clip().qpos[:, 2]).max() < 0.01
    assert said == [
        "high: high.csv (lafan1 by the ground, 30 fps assumed); `kinetok clips import --fps` takes another",
        "high: fixed   floor    the feet stand +0.200 m over the floor all the time; shifted onto it",
    ]
    ClipLibrary.write(tmp_path / "own.safetensors", [raised])  # has been through it, or is meant so
    (own,) = read_clips(tmp_path / "own.safetensors", say=said.append)
    assert abs(own.qpos - raised.qpos).max() < 1e-5 and len(said) == 2


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda qpos: qpos[:, :3] * 100, "high on a body of 1.05 m: its position is in another unit"),
        (lambda qpos: qpos[:, :3] + np.linspace(0, 160, len(qpos))[:, None] * [1, 0, 0], "the root moves at 30"),
        (lambda qpos: qpos[:, :3] - np.linspace(0.4, 0.8, len(qpos))[:, None] * [0, 0, 1], "under the floor, as where"),
    ],
    ids=["unit", "leap", "axes"],
)
def test_what_no_repair_helps_is_refused_and_named(tmp_path, squat, change, reason):
    clip = squat.clip()
    qpos = np.concatenate([clip.qpos] * 4)
    qpos[:, :3] = change(qpos)
    write_robot_csv(tmp_path / "odd.csv", replace(clip, qpos=qpos))
    with pytest.raises(FormatError, match=rf"odd\.csv: odd.*{reason}"):
        read_clips(tmp_path / "odd.csv", dialect="lafan1")


def test_a_joint_that_leaps_is_said_and_let_in(data_dir):
    pytest.importorskip("mink")
    said: list[str] = []
    assert len(read_clips(data_dir / "bvh" / "fair1" / "dab.bvh", say=said.append)) == 1
    assert any(line.startswith("dab: jump") and "cut it there or leave it out" in line for line in said)
    assert said[-1].startswith("dab: on humanoid (family fair1), joints ") and "feet slide by 0.0" in said[-1]


@pytest.mark.parametrize("fps", [0.001, 2000.0])
def test_no_motion_has_such_a_rate(tmp_path, data_dir, fps):
    (poses,) = read(data_dir / "smpl" / "synthetic_run_09_01_poses.npz")
    write_amass(tmp_path / "odd_poses.npz", replace(poses, fps=fps))
    with pytest.raises(
        FormatError, match=rf"odd_poses\.npz: odd_poses: {fps:.4g} frames per second; a motion has 1 to"
    ):
        read(tmp_path / "odd_poses.npz")


def test_what_cannot_be_fitted_is_of_its_file_and_what_is_asked_for_is_not(tmp_path, data_dir, tiny):
    lines = (data_dir / "bvh" / "cmu_motionbuilder" / "cmu_12_01_walk.bvh").read_text().splitlines()
    at = next(number for number, line in enumerate(lines) if line.startswith("Frames"))
    (tmp_path / "short.bvh").write_text("\n".join([*lines[:at], "Frames: 2", *lines[at + 1 : at + 4], ""]))
    refused = []
    assert list(each_clip(tmp_path / "short.bvh", skip=refused.append)) == []
    assert "short.bvh: short: " in str(refused[0]) and "fewer than two frames at 30" in str(refused[0])
    (tmp_path / "tiny.xml").write_text(tiny.xml)
    with pytest.raises(ConfigError, match="no body is named"):
        list(each_clip(data_dir / "bvh" / "snu_mass" / "walk.bvh", str(tmp_path / "tiny.xml"), skip=refused.append))


def test_the_clips_of_a_library_are_read_one_by_one_and_drawn_unread(tmp_path, monkeypatch):
    squat = sway("c", 20, loop=False)
    names = [f"c{number:02d}" for number in range(40)]
    ClipLibrary.write(tmp_path / "all.safetensors", (replace(squat, name=name) for name in names))
    ClipLibrary.append(tmp_path / "parts", [replace(squat, name="part")])
    opened = []
    monkeypatch.setattr(ClipLibrary, "clip", lambda self, i: (opened.append(i), clip_of(self, i))[1])
    clips = each_clip(tmp_path / "all.safetensors")
    assert not opened and next(clips).name == "c00" and opened == [0]
    opened.clear()
    drawn = draw_clips([tmp_path / "all.safetensors", tmp_path / "parts"], 6.5 * squat.seconds / 3600, seed=0)
    assert len(drawn) == len(opened) == 7 and [clip.name for clip in drawn] == sorted(clip.name for clip in drawn)
    again = draw_clips([tmp_path / "all.safetensors", tmp_path / "parts"], 6.5 * squat.seconds / 3600, seed=1)
    assert {clip.name for clip in again} != {clip.name for clip in drawn}
    assert len(draw_clips([tmp_path / "parts"], 100.0, seed=0)) == 1
    ClipLibrary.append(tmp_path / "parts" / "more", [squat])
    assert open_library(tmp_path / "parts") is None  # what lies deeper is read as well, so it is no one library
    (tmp_path / "parts" / "walk.bvh").write_text("HIERARCHY")
    assert open_library(tmp_path / "parts") is None and open_library(tmp_path / "walk.txt") is None


clip_of = ClipLibrary.clip
