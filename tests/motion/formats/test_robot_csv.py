"""robot_csv.py: each dialect reads back what it writes, is told apart, and says what it assumed."""

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.clip import Clip
from kinetok.motion.formats import FormatError, read, read_robot_csv, write_robot_csv
from kinetok.motion.formats.g1 import JOINTS, load_g1
from kinetok.motion.formats.robot_csv import DIALECTS, is_robot_csv
from kinetok.motion.kinematics import lowest_point


@pytest.mark.parametrize("dialect", DIALECTS)
def test_round_trip(tmp_path, squat, dialect):
    clip, path = squat.clip().resample(DIALECTS[dialect].fps), tmp_path / "deep" / "squat.csv"
    write_robot_csv(path, clip, dialect=dialect)
    back = read_robot_csv(path)
    assert (back.name, back.character, back.fps) == ("squat", "g1", pytest.approx(clip.fps))
    np.testing.assert_allclose(back.qpos, clip.qpos, atol=2e-9)
    told = "by its header" if dialect == "bones-seed" else "by the ground"
    assert back.source == f"squat.csv ({dialect} {told}, {clip.fps:g} fps assumed)"
    assert [p.name for p in path.parent.iterdir()] == ["squat.csv"]


def test_what_the_caller_says_is_believed_and_noted(tmp_path, squat):
    path = tmp_path / "squat.csv"
    write_robot_csv(path, squat.clip(), dialect="kimodo")
    clip = read_robot_csv(path, dialect="kimodo", fps=60)
    assert clip.fps == 60 and clip.source == "squat.csv (kimodo as asked, 60 fps as asked)"
    other = read_robot_csv(path, dialect="lafan1")
    np.testing.assert_allclose(np.abs(other.qpos[:, 3:7]), np.abs(squat.quats[:, [3, 0, 1, 2]]), atol=1e-8)


def test_the_columns_of_a_written_file_by_hand(tmp_path, squat):
    roll, pitch, yaw = 0.1, -0.2, 0.3
    about = [rotation.from_rotvec(v) for v in np.diag([roll, pitch, yaw])]
    qpos = squat.qpos.copy()
    qpos[:, 3:7] = rotation.multiply(about[2], rotation.multiply(about[1], about[0]))  # extrinsic x, y, z
    path = tmp_path / "x.csv"
    write_robot_csv(path, Clip(name="x", character="g1", fps=120.0, qpos=qpos), dialect="bones-seed")
    header, first, *_ = path.read_text().splitlines()
    assert header.startswith("Frame,root_translateX,root_translateY,root_translateZ,root_rotateX,")
    assert header.split(",")[7:] == [f"{name}_joint_dof" for name in JOINTS]
    values = [float(cell) for cell in first.split(",")]
    assert values[0] == 0 and values[1:4] == pytest.approx((100 * qpos[0, :3]).tolist(), abs=1e-6)
    assert values[4:7] == pytest.approx(np.rad2deg([roll, pitch, yaw]).tolist(), abs=1e-6)
    assert values[7:] == pytest.approx(np.rad2deg(qpos[0, 7:]).tolist(), abs=1e-6)


def test_joint_columns_are_found_by_name(tmp_path, squat):
    path = tmp_path / "x.csv"
    write_robot_csv(path, squat.clip().resample(120), dialect="bones-seed")
    clip = read_robot_csv(path)
    rows = [line.split(",") for line in path.read_text().splitlines()]
    order = np.random.default_rng(0).permutation(len(rows[0]))
    path.write_text("\n".join(",".join(row[i] for i in order) for row in rows))
    np.testing.assert_array_equal(read_robot_csv(path).qpos, clip.qpos)
    path.write_text("\n".join(",".join(row[:-3]) for row in rows))
    with pytest.raises(
        FormatError, match="line 1: the header lacks right_wrist_roll, right_wrist_pitch, right_wrist_yaw"
    ):
        read_robot_csv(path)


def test_every_collected_file(data_dir):
    clips = {p: read(p)[0] for p in sorted((data_dir / "g1").glob("*/*.csv"))}
    assert len(clips) == 16
    for path, clip in clips.items():
        assert clip.source.startswith(f"{path.name} ({'kimodo' if 'kimodo' in path.name else 'lafan1'} by the ground")
        low = lowest_point(load_g1("g1"), clip.qpos)
        assert -0.04 < np.percentile(low, 5) < 0.01 and abs(np.median(low)) < 0.02, path.name
        up = rotation.rotate(clip.qpos[:, 3:7], np.array([0.0, 0.0, 1.0]))[:, 2]
        assert np.percentile(up, 5) > 0.8, path.name
        assert ((clip.qpos[1:, 3:7] * clip.qpos[:-1, 3:7]).sum(-1) > 0).all()


def test_a_motion_that_fits_both_orders_needs_a_dialect(tmp_path):
    path = tmp_path / "still.csv"
    path.write_text("\n".join([",".join(["0", "0", "0.79", "0", "0", "0", "1"] + ["0"] * 29)] * 5))
    with pytest.raises(
        FormatError, match="columns 3-6: the motion fits x y z w and w x y z alike; say which: --dialect"
    ):
        read_robot_csv(path)
    assert read_robot_csv(path, dialect="lafan1").qpos[0, 3] == 1
    assert read_robot_csv(path, dialect="kimodo").qpos[0, 6] == 1


def lines(squat) -> list[str]:
    return [",".join(f"{x:.6f}" for x in row) for row in np.concatenate([squat.root, squat.xyzw, squat.joints], axis=1)]


def cell(rows: list[str], row: int, column: int, text: str) -> list[str]:
    cells = rows[row].split(",")
    cells[column] = text
    return [*rows[:row], ",".join(cells), *rows[row + 1 :]]


@pytest.mark.parametrize(
    ("change", "where", "reason"),
    [
        (lambda rows: [], "file", "is empty"),
        (lambda rows: ["", " "], "file", "is empty"),
        (lambda rows: rows[:1], "file", "1 frames; a motion needs at least two"),
        (lambda rows: [row.rpartition(",")[0] for row in rows], "line 1", "35 columns; the format has 36"),
        (lambda rows: [*rows[:3], rows[3] + ",1"], "line 4", "37 columns; the lines before have 36"),
        (lambda rows: [*rows[:3], "", *rows[4:]], "line 4", "1 columns; the lines before have 36"),
        (lambda rows: cell(rows, 4, 9, "x"), "line 5, column 9", "'x' is not a number"),
        (lambda rows: cell(rows, 4, 9, "nan"), "row, column [4, 9]", "nan is not a finite number"),
        (lambda rows: cell(rows, 4, 9, "1e999"), "row, column [4, 9]", "inf is not a finite number"),
        (lambda rows: cell(rows, 4, 6, "9"), "columns 3-6[4]", "is no rotation"),
        (lambda rows: cell(rows, 4, 9, "90"), "frame 4, left_hip_yaw", "are these degrees"),
        (lambda rows: [row.replace(",", ";") for row in rows], "line 1", "neither numbers nor BONES-SEED's names"),
        (lambda rows: ["time," + "q," * 34 + "q", *rows], "line 1", "neither numbers nor BONES-SEED's names"),
    ],
)
def test_malformed_files(tmp_path, squat, change, where, reason):
    path = tmp_path / "x.csv"
    path.write_text("\n".join(change(lines(squat))))
    with pytest.raises(FormatError) as caught:
        read_robot_csv(path)
    assert caught.value.where == where and reason in str(caught.value)


def test_what_is_no_text(tmp_path, squat):
    path = tmp_path / "x.csv"
    path.write_bytes("\ufeff".encode() + "\r\n".join(lines(squat)).encode())
    assert is_robot_csv(path) and len(read_robot_csv(path).qpos) == 40
    path.write_bytes(b"\xff\xfe0,1,2")
    assert not is_robot_csv(path)
    with pytest.raises(FormatError, match="byte 0: not text"):
        read_robot_csv(path)
    path.write_text("name,seconds\nwalk,3\n")
    assert not is_robot_csv(path)


def test_calls_that_contradict(tmp_path, squat):
    path = tmp_path / "x.csv"
    with pytest.raises(ValueError, match=r"unknown dialect 'lafan'.*one of: lafan1, kimodo, bones-seed"):
        read_robot_csv(path, dialect="lafan")
    with pytest.raises(
        ValueError, match=r"30 fps, but bones-seed files carry no rate and are read at 120; write clip.res"
    ):
        write_robot_csv(path, squat.clip(), dialect="bones-seed")
    write_robot_csv(path, squat.clip())
    with pytest.raises(FormatError, match="line 1: has no header; a bones-seed file names its columns"):
        read_robot_csv(path, dialect="bones-seed")
    write_robot_csv(path, squat.clip().resample(120), dialect="bones-seed")
    with pytest.raises(FormatError, match="line 1: has a header; 'kimodo' files have none"):
        read_robot_csv(path, dialect="kimodo")
