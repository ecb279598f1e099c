"""deepmimic.py: every collected file reads well, malformed ones are refused with the place, odd ones are mended."""

import json

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.clip import quaternion_columns
from kinetok.motion.formats import FormatError, read_clips, read_deepmimic
from kinetok.motion.kinematics import lowest_point

QUATERNIONS = [4, 8, 12, 16, 21, 25, 30, 35, 39]  # first column of each in the file, duration included


def test_every_collected_file_reads(data_dir, humanoid):
    clips = [clip for folder in ("deepmimic", "deepmimic_long") for clip in read_clips(data_dir / "train" / folder)]
    assert len(clips) == 24
    for clip in clips:
        low = lowest_point(humanoid, clip.qpos)
        assert -0.04 < np.percentile(low, 1) < 0.01, clip.name
        columns = quaternion_columns(humanoid)[:, None] + np.arange(4)
        quats = clip.qpos[:, columns]
        np.testing.assert_allclose(np.linalg.norm(quats, axis=-1), 1, atol=1e-9, err_msg=clip.name)
        assert ((quats[1:] * quats[:-1]).sum(-1) > 0).all(), clip.name
        assert 0.3 < np.median(clip.qpos[:, 2]) < 1.3 or "getup" in clip.name or clip.name == "crawl", clip.name


def test_the_walk_faces_and_goes_along_x(walk):
    assert walk.loop and walk.name == "walk" and walk.fps == pytest.approx(30, rel=1e-3)
    assert rotation.heading(walk.qpos[0, 3:7]) == pytest.approx(0.0, abs=0.1)
    travel = walk.qpos[-1, :2] - walk.qpos[0, :2]
    assert travel[0] > 1.0 and abs(travel[1]) < 0.2
    np.testing.assert_allclose(walk.qpos[-1, 2:], walk.qpos[0, 2:], atol=1e-9)


def synthetic(times: np.ndarray) -> dict:
    """A slide along x at 1 m/s that yaws 0.5 rad/s and bends an elbow 0.4 rad/s, frames at these times."""
    rows = np.zeros((len(times), 44))
    rows[:-1, 0] = np.diff(times)
    rows[:, 1], rows[:, 2] = times, 0.9
    rows[:, QUATERNIONS] = 1.0
    rows[:, 4], rows[:, 6] = np.cos(0.25 * times), np.sin(0.25 * times)  # about the file's vertical, y
    rows[:, 29] = 0.4 * times
    return {"Loop": "none", "Frames": rows.tolist()}


def write(tmp_path, data) -> "object":
    path = tmp_path / "humanoid3d_made.txt"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def test_a_synthetic_clip(tmp_path, humanoid):
    clip = read_deepmimic(write(tmp_path, synthetic(np.arange(11) / 20)))
    assert (clip.name, clip.source, clip.fps) == ("made", "humanoid3d_made.txt", pytest.approx(20.0))
    np.testing.assert_allclose(clip.qpos[:, 0], np.arange(11) / 20, atol=1e-12)
    np.testing.assert_allclose(rotation.heading(clip.qpos[:, 3:7]), np.arange(11) / 40, atol=1e-12)
    elbow = humanoid.model.joint("right_elbow").qposadr[0]
    np.testing.assert_allclose(clip.qpos[:, elbow], 0.4 * np.arange(11) / 20, atol=1e-12)


def test_uneven_durations_are_resampled(tmp_path, humanoid):
    times = np.array([0, 1, 2, 4, 5, 8, 9, 10]) / 20
    clip = read_deepmimic(write(tmp_path, synthetic(times)))
    assert (clip.fps, len(clip.qpos)) == (pytest.approx(20.0), 11)
    np.testing.assert_allclose(clip.qpos[:, 0], np.arange(11) / 20, atol=1e-9)
    np.testing.assert_allclose(rotation.heading(clip.qpos[:, 3:7]), np.arange(11) / 40, atol=1e-9)


def test_frames_of_no_duration_are_left_out(tmp_path):
    data = synthetic(np.arange(6) / 20)
    data["Frames"].insert(3, [0.0, *data["Frames"][3][1:]])
    np.testing.assert_allclose(read_deepmimic(write(tmp_path, data)).qpos[:, 0], np.arange(6) / 20, atol=1e-9)


def test_scaled_and_flipped_quaternions_give_the_same_clip(tmp_path, data_dir):
    path = data_dir / "train" / "deepmimic" / "humanoid3d_walk.txt"
    data, rng = json.loads(path.read_text()), np.random.default_rng(0)
    for row in data["Frames"]:
        for column in QUATERNIONS:
            scale = rng.choice([-1, 1]) * rng.uniform(0.5, 1.5) if row is not data["Frames"][0] else 1.3
            row[column : column + 4] = [scale * x for x in row[column : column + 4]]
    np.testing.assert_allclose(read_deepmimic(write(tmp_path, data)).qpos, read_deepmimic(path).qpos, atol=1e-9)


def spoil(frame: int, column: int, *values) -> dict:
    data = synthetic(np.arange(5) / 20)
    data["Frames"][frame][column : column + len(values)] = values
    return data


def without(key: str) -> dict:
    return {k: v for k, v in synthetic(np.arange(5) / 20).items() if k != key}


@pytest.mark.parametrize(
    ("data", "where", "reason"),
    [
        ('{"Frames": [[', "line 1", "not JSON"),
        ("[1, 2]", "top level", 'no "Frames"'),
        (without("Frames"), "top level", '"Loop": ..., "Frames"'),
        (synthetic(np.arange(5) / 20) | {"Loop": "around"}, "Loop", '\'around\'; it is "wrap" or "none"'),
        ({"Frames": []}, "Frames", "at least two frames"),
        ({"Frames": [[0.0] * 44]}, "Frames", "at least two frames"),
        ({"Frames": [[0.0] * 44, [0.0] * 36]}, "frame 1", "36 columns; the format has 44 (duration + 43 numbers)"),
        ({"Frames": [[0.0] * 44, 3]}, "frame 1", "int columns"),
        (spoil(2, 7, "x"), "Frames", "not a number"),
        (spoil(2, 7, None), "frame 2, column 7", "nan is not a finite number"),
        (spoil(2, 7, float("nan")), "frame 2, column 7", "nan is not a finite number"),
        (spoil(3, 0, float("inf")), "frame 3, column 0", "inf is not a finite number"),
        (spoil(1, 0, -0.1), "frame 1, column 0", "duration -0.1 is negative"),
        (spoil(3, 8, 0, 0, 0, 0), "frame 3, columns 8-11", "a zero quaternion is no rotation"),
        (synthetic(np.zeros(5)), "Frames", "fewer than two frames of positive duration"),
    ],
)
def test_malformed_files(tmp_path, data, where, reason):
    path = write(tmp_path, data)
    with pytest.raises(FormatError) as caught:
        read_deepmimic(path)
    assert caught.value.where == where and caught.value.path == path
    assert str(caught.value).startswith(f"{path}: {where}: ") and reason in str(caught.value)


def test_read_clips_messages(tmp_path):
    with pytest.raises(FormatError, match="does not exist"):
        read_clips(tmp_path / "none.txt")
    with pytest.raises(FormatError, match="holds no motion file; formats: DeepMimic"):
        read_clips(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(FormatError, match="first bytes: unknown format"):
        read_clips(tmp_path / "notes.txt")


def test_quaternions_made_unit_are_said(data_dir):
    kick, walk = (
        read_deepmimic(data_dir / "train" / "deepmimic" / f"humanoid3d_{name}.txt") for name in ("kick", "walk")
    )
    assert kick.source.endswith("(quaternions made unit, the furthest of norm 0.58 in frame 27, columns 16-19)")
    assert walk.source == "humanoid3d_walk.txt"
