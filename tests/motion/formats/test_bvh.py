"""bvh.py: every collected file reads like bvhio reads it, survives being written, and malformed ones name the line."""

from dataclasses import replace
from pathlib import Path

import bvhio
import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.error import FormatError
from kinetok.motion.formats.axes import ORDERS, from_euler, to_euler, y_up, z_up
from kinetok.motion.formats.bvh import read_bvh, write_bvh
from kinetok.motion.formats.conventions import FAMILIES, family_of, unit_of
from kinetok.motion.skeleton import SkeletonMotion

# file: family, unit, metres per unit, world's up axis, joints, frames, fps
FILES = {
    **{
        f"bvh/cmu_daz/cmu_{name}.bvh": ("cmu-daz", "cm", 0.01, "y", 43, frames, 120)
        for name, frames in {
            "02_01": 344, "02_03": 174, "02_05": 1855, "05_03": 435, "09_01": 149,
            "11_01": 598, "13_11": 416, "13_39": 352, "14_31": 2095,
        }.items()
    },
    **{
        f"bvh/snu_mass/{name}.bvh": ("snu-mass", "cm", 0.01, "y", 37, frames, 120)
        for name, frames in {"balance": 416, "dance": 381, "kick": 231, "run": 66, "walk": 132}.items()
    },
    "bvh/cmu_max/jumping_jacks.bvh": ("cmu-3dsmax", "cmu", 0.0254 / 0.45, "y", 31, 125, 30),
    "bvh/cmu_motionbuilder/cmu_12_01_walk.bvh": ("cmu-motionbuilder", "cmu", 0.0254 / 0.45, "y", 31, 524, 120),
    "amc/01_01_first600.bvh": ("cmu-motionbuilder", "cmu", 0.0254 / 0.45, "y", 31, 601, 120),
    "bvh/fair1/dab.bvh": ("fair1", "guessed: 0.038 m, for a leg of 0.82 m", 0.038, "z", 27, 339, 30),
    "bvh/fair1/jumping.bvh": ("fair1", "guessed: 0.038 m, for a leg of 0.82 m", 0.038, "z", 27, 654, 120 / 1.001),
    "bvh/pymo/AV_8Walk_Meredith_HVHA_Rep1.bvh": ("pymo", "in", 0.0254, "y", 23, 1064, 120),
    "bvh/edge/hands_60joints.bvh": ("mixamo-like", "guessed: in", 0.0254, "z", 60, 100, 120),
    "bvh/edge/rotation_first_root.bvh": ("", "guessed: cmu", 0.0254 / 0.45, "y", 4, 4, 25),
    "bvh/edge/full_precision_frame_time.bvh": ("", "guessed: cm", 0.01, "y", 2, 3, 23.976),
}  # fmt: skip


@pytest.fixture(scope="module")
def motions(data_dir) -> dict[str, SkeletonMotion]:
    return {name: read_bvh(data_dir / name) for name in FILES}


def test_the_table_names_every_file(data_dir):
    assert {path.relative_to(data_dir).as_posix() for path in data_dir.rglob("*.bvh")} == set(FILES)


def test_what_each_file_is(motions):
    for name, (family, unit, _, _, joints, frames, fps) in FILES.items():
        motion = motions[name]
        assert (motion.family, motion.unit, len(motion.joints), len(motion.root)) == (family, unit, joints, frames), (
            name
        )
        assert motion.fps == pytest.approx(fps, rel=1e-9), name
        assert (motion.name, motion.source) == (Path(name).stem, Path(name).name)


def test_every_body_stands_on_the_ground_at_human_size(motions):
    for name, motion in motions.items():
        if motion.family:
            positions = motion.pose()[0]
            hips = np.percentile(motion.root[:, 2], 90)
            low = np.percentile(positions[..., 2].min(1), 5)
            assert 0.6 < hips < 1.25 and -0.05 < low < 0.15, (name, hips, low)
            head = next(joint for joint, each in enumerate(motion.joints) if each.lower().endswith("head"))
            rest = np.zeros((len(motion.joints), 3))
            for joint, parent in enumerate(motion.parents[1:], start=1):
                rest[joint] = rest[parent] + motion.offsets[joint]
            assert 0.35 < rest[head, 2] < 0.8 and abs(rest[head, :2]).max() < 0.2, name  # the rest pose stands z up


def bvhio_positions(path: Path, draft: Path, frames: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Joint names and world positions (F, J, 3) in the file's axes and unit, of these frames only: bvhio is slow."""
    head, _, body = path.read_text().partition("MOTION")
    rows = [line for line in body.splitlines() if line.strip()]
    draft.write_text("\n".join([f"{head}MOTION\nFrames: {len(frames)}", rows[1], *(rows[2 + n] for n in frames), ""]))
    root = bvhio.readAsHierarchy(str(draft))
    layout = [joint for joint, _, _ in root.layout()]
    positions = []
    for frame in range(len(frames)):
        root.loadPose(frame)
        positions.append([tuple(joint.PositionWorld) for joint in layout])
    return [joint.Name for joint in layout], np.array(positions)


@pytest.mark.parametrize("count", [4, pytest.param(10**9, marks=pytest.mark.slow)])
def test_positions_are_those_of_bvhio(motions, data_dir, tmp_path, count):
    """So many frames of every file, all of them by `make slow`; bvhio computes in single precision."""
    for name, (_, _, metres, up, *_) in FILES.items():
        motion = motions[name]
        frames = np.linspace(0, len(motion.root) - 1, min(count, len(motion.root))).astype(int)
        names, expected = bvhio_positions(data_dir / name, tmp_path / "part.bvh", frames)
        assert tuple(names) == motion.joints
        expected = (z_up(expected) if up == "y" else expected) * metres
        height = np.ptp(expected[..., 2], axis=1).max()
        assert np.abs(motion.pose()[0][frames] - expected).max() < 1e-5 * height, name


def test_every_file_survives_being_written(motions, tmp_path):
    for number, (name, motion) in enumerate(motions.items()):
        order = ORDERS[number % len(ORDERS)]
        write_bvh(tmp_path / "copy.bvh", motion, order=order)
        again = read_bvh(tmp_path / "copy.bvh")
        assert (again.joints, again.parents, again.family) == (motion.joints, motion.parents, motion.family)
        assert again.unit == "cm" and again.fps == pytest.approx(motion.fps, rel=1e-9)
        apart = rotation.multiply(rotation.conjugate(motion.local), again.local)
        assert np.linalg.norm(rotation.to_rotvec(apart), axis=-1).max() < 1e-6, (name, order)
        assert np.abs(again.offsets - motion.offsets).max() < 1e-7, name
        assert np.abs(again.root - motion.root).max() < 1e-7, name


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_of_every_order(order):
    rng = np.random.default_rng(0)
    angles = rng.uniform(-np.pi, np.pi, (200, 3))
    angles[:40, 1] = np.repeat([np.pi / 2, -np.pi / 2], 20) + np.tile(np.repeat([0, 1e-12, -1e-7, 1e-4], 5), 2)
    q = from_euler(angles, order)
    by_hand = np.array([1.0, 0, 0, 0])
    for axis, angle in zip(order, angles[0], strict=True):  # each turn is about the axis as the ones before left it
        by_hand = rotation.multiply(
            rotation.from_rotvec(angle * rotation.rotate(by_hand, np.eye(3)["XYZ".index(axis)])), by_hand
        )
    np.testing.assert_allclose(rotation.to_matrix(q[0]), rotation.to_matrix(by_hand), atol=1e-12)
    again = from_euler(to_euler(q, order), order)
    assert np.abs(rotation.to_matrix(again) - rotation.to_matrix(q)).max() < 1e-6


def test_up_axes():
    v = np.array([1.0, 2.0, 3.0])
    assert z_up(v).tolist() == [1, -3, 2] and y_up(z_up(v)).tolist() == v.tolist()
    q = rotation.from_rotvec(np.array([0.3, -0.7, 1.1]))
    np.testing.assert_allclose(rotation.rotate(z_up(q), z_up(v)), z_up(rotation.rotate(q, v)), atol=1e-12)


def test_families_by_name():
    for family, rig in FAMILIES.items():
        assert family_of(sorted(rig.required())) == family
        assert family_of(sorted(rig.required())[1:]) != family
    assert family_of(["mixamorig:" + name for name in FAMILIES["mixamo-like"].required()]) == "mixamo-like"


@pytest.mark.parametrize(
    ("family", "leg", "height", "unit", "metres"),
    [
        ("cmu-daz", 82.2, 180, "cm", 0.01),
        ("cmu-daz", 0.82, 1.8, "guessed: m", 1.0),  # someone scaled the rig
        ("cmu-motionbuilder", 82.0, 180, "guessed: cm", 0.01),
        ("", 820, 0, "guessed: mm", 0.001),
        ("", 32.3, 0, "guessed: in", 0.0254),
        ("", 14.5, 0, "guessed: cmu", 0.0254 / 0.45),
        ("", 21.7, 0, "guessed: 0.037788 m, for a leg of 0.82 m", 0.82 / 21.7),
        ("fair1", 82, 0, "guessed: cm", 0.01),
        ("", 0, 1.7, "guessed: m", 1.0),
        ("", 0, 5000, "guessed: cm", 0.01),
    ],
)
def test_units_by_size(family, leg, height, unit, metres):
    assert unit_of(family, leg, height) == (unit, pytest.approx(metres))


HEAD = """HIERARCHY
ROOT Hips
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Head
  {
    OFFSET 0 10 0
    CHANNELS 3 Yrotation Zrotation Xrotation
    End Site
    {
      OFFSET 0 5 0
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.05
"""
ROWS = "0 90 0 0 0 0 0 0 0\n1 90 0 0 0 10 0 0 0\n2 90 0 0 0 90 0 90 0\n"


def make(tmp_path, text: str | bytes) -> Path:
    path = tmp_path / "made.bvh"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_file_by_hand(tmp_path):
    motion = read_bvh(make(tmp_path, HEAD + ROWS), unit="cm")
    assert (motion.joints, motion.parents, motion.fps, motion.unit) == (("Hips", "Head"), (-1, 0), 20, "cm")
    np.testing.assert_allclose(
        motion.root, [[0, 0, 0.9], [0.01, 0, 0.9], [0.02, 0, 0.9]], atol=1e-12
    )  # no OFFSET added
    np.testing.assert_allclose(motion.offsets, [[0, 0, 0], [0, 0, 0.1]], atol=1e-12)
    # frame 2: the root turns 90 degrees about the vertical, the head 90 degrees about its own forward axis
    head = motion.pose()[1][2, 1]
    np.testing.assert_allclose(rotation.rotate(head, np.array([1.0, 0, 0])), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(rotation.rotate(head, np.array([0.0, 0, 1])), [0, -1, 0], atol=1e-9)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r\n", 14),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("  ", "\t").replace("Xposition", "XPOSITION").replace("End Site", "end site"),
        lambda text: text.replace("\n{", " {").replace(" 90 ", "\t9e1   ") + "\n\n",
        lambda text: text.replace("Frames: 3", "Frames:\t3").replace("Frame Time: 0.05", "frame time : .05"),
    ],
)
def test_spellings(tmp_path, change):
    plain = read_bvh(make(tmp_path, HEAD + ROWS))
    other = read_bvh(make(tmp_path, change(HEAD + ROWS)))
    assert (other.joints, other.fps, other.unit) == (plain.joints, plain.fps, plain.unit)
    np.testing.assert_array_equal(other.root, plain.root)
    np.testing.assert_array_equal(other.local, plain.local)


@pytest.mark.parametrize(
    ("written", "fps"),
    [
        (".0083333", 120), ("0.008333", 120), ("0.00833333", 120), (".03333", 30), ("0.0333333", 30), ("0.016667", 60),
        ("0.008342", 120 / 1.001), ("0.0333667", 30 / 1.001), ("0.0417083750417", 23.976), ("0.033", 1 / 0.033),
        ("4e-2", 25), ("0.0081", 1 / 0.0081), ("2", 0.5),
    ],
)  # fmt: skip
def test_frame_times(tmp_path, written, fps):
    assert read_bvh(make(tmp_path, HEAD.replace("0.05", written) + ROWS)).fps == pytest.approx(fps, rel=1e-12)


SIX = "CHANNELS 6 Xposition Yposition Zposition Yrotation Zrotation Xrotation"


def positioned(*places: str) -> str:
    """The file with position channels on the head, one triple for each frame."""
    rows = [row.split() for row in ROWS.splitlines()]
    lines = [" ".join(row[:6] + place.split() + row[6:]) for row, place in zip(rows, places, strict=True)]
    return HEAD.replace("CHANNELS 3 Yrotation Zrotation Xrotation", SIX) + "\n".join(lines)


def test_position_channels_below_the_root(tmp_path):
    plain = read_bvh(make(tmp_path, HEAD + ROWS), unit="m")
    for place in ("0 10 0", "0 0 0"):  # absolute, and counted from OFFSET
        same = read_bvh(make(tmp_path, positioned(place, place, place)), unit="m")
        np.testing.assert_array_equal(same.offsets, plain.offsets)
    other = read_bvh(make(tmp_path, positioned(*["0 12 0"] * 3)), unit="m")
    np.testing.assert_allclose(other.offsets[1], [0, 0, 12])


def test_a_root_that_only_carries_a_moving_joint_is_folded_into_it(tmp_path):
    motion = read_bvh(make(tmp_path, positioned("0 10 0", "1 11 0", "2 12 0")), unit="m", up="y")
    assert (motion.joints, motion.parents) == (("Head",), (-1,))
    # Hips at (2, 90, 0) turned 90 degrees about y takes (2, 12, 0) to (0, 12, -2): (2, 102, -2) is (2, 2, 102) z up
    np.testing.assert_allclose(
        motion.root, [[0, 0, 100], [1 + np.cos(np.radians(10)), np.sin(np.radians(10)), 101], [2, 2, 102]]
    )
    whole = read_bvh(make(tmp_path, HEAD + ROWS), unit="m", up="y")
    np.testing.assert_allclose(motion.pose()[1][:, 0], whole.pose()[1][:, 1], atol=1e-12)


def test_bones_that_change_their_length_are_refused(tmp_path):
    arm = "  JOINT Arm\n  {\n    OFFSET 4 0 0\n    CHANNELS 0\n  }\n}\nMOTION"
    text = positioned("0 10 0", "1 11 0", "2 12 0").replace("}\nMOTION", arm)
    with pytest.raises(FormatError, match="line 6: the position channels of 'Head' vary by 2 units"):
        read_bvh(make(tmp_path, text))


def lying() -> SkeletonMotion:
    """A Daz-like body lying on the floor, head along the z axis of a y-up file; in metres, z up."""
    names = ("hip", "head", "lThigh", "lShin", "lFoot")
    offsets = np.array([[0, 0, 0], [0, 0, 0.6], [0.1, 0, 0], [0, 0, -0.4], [0, 0, -0.45]])
    local = np.zeros((3, 5, 4))
    local[..., 0] = 1
    local[:, 0] = rotation.from_rotvec(np.array([np.pi / 2, 0, 0]))
    root = np.array([[0.3, -5.0, 0.1]] * 3)
    return SkeletonMotion(
        name="lying", fps=30, joints=names, parents=(-1, 0, 0, 2, 3), offsets=offsets, local=local, root=root
    )


def test_a_body_that_lies_down_keeps_the_up_axis(tmp_path):
    write_bvh(tmp_path / "lying.bvh", lying())
    text = (tmp_path / "lying.bvh").read_text().replace("0.600000 0.800000", "0.000000 0.000000")  # no ruler
    motion = read_bvh(make(tmp_path, text))
    assert motion.unit == "guessed: cm"
    np.testing.assert_allclose(motion.pose()[0], lying().pose()[0], atol=1e-7)


def test_a_small_robot_keeps_its_size(tmp_path):
    robot = lying()
    robot = replace(robot, offsets=robot.offsets * 0.01, root=robot.root * 0.01)
    write_bvh(tmp_path / "robot.bvh", robot)
    np.testing.assert_allclose(read_bvh(tmp_path / "robot.bvh").pose()[0], robot.pose()[0], atol=1e-7)


def test_what_the_caller_says_wins(tmp_path):
    path = make(tmp_path, HEAD + ROWS)
    motion = read_bvh(path, unit="in", up="z")
    assert motion.unit == "in"
    np.testing.assert_allclose(motion.root[1], [0.0254, 90 * 0.0254, 0], atol=1e-12)
    with pytest.raises(ValueError, match="unit 'feet'; known units: m, cm, mm, in, cmu"):
        read_bvh(path, unit="feet")
    with pytest.raises(ValueError, match="up axis 'x'"):
        read_bvh(path, up="x")


def test_written_files_are_depth_first_and_whole(tmp_path):
    motion = lying()
    motion = replace(motion, parents=(-1, 0, 0, 1, 2))
    write_bvh(tmp_path / "new" / "a.bvh", motion)
    assert read_bvh(tmp_path / "new" / "a.bvh").joints == ("hip", "head", "lShin", "lThigh", "lFoot")
    assert [each.name for each in (tmp_path / "new").iterdir()] == ["a.bvh"]
    with pytest.raises(ValueError, match="rotation order 'ZXZ'; it is one of XYZ"):
        write_bvh(tmp_path / "b.bvh", motion, order="ZXZ")


def edit(old: str, new: str) -> str:
    assert old in HEAD + ROWS
    return (HEAD + ROWS).replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "where", "reason"),
    [
        ("", "line 1", "the file is empty"),
        (" \n\n", "line 1", "the file is empty"),
        ((HEAD + ROWS).encode().replace(b"Head", b"K\xf6pf"), "line 6", "byte 0xf6 is not UTF-8 text"),
        ((HEAD + ROWS).encode("utf-16"), "line 1", "is not UTF-8 text"),
        ("Loop: 1", "line 1", "a BVH file begins with HIERARCHY"),
        ("HIERARCHY\nMOTION\n", "line 1", "the hierarchy holds no ROOT"),
        (edit("ROOT Hips", "JOINT Hips"), "line 2", "JOINT Hips does not belong here"),
        (edit("  JOINT Head", "  ROOT Head"), "line 6", "ROOT Head does not belong here"),
        (edit("}\nMOTION", "}\nROOT Two\n{\n}\nMOTION"), "line 16", "a file holds one ROOT"),
        (edit("      OFFSET 0 5 0", "JOINT Deep\n{\n}"), "line 12", "JOINT Deep does not belong here"),
        (edit("ROOT Hips\n{", "ROOT Hips\n"), "line 2", "ROOT Hips is not followed by a '{'"),
        (edit("JOINT Head", "JOINT Hips"), "line 6", "two joints are named 'Hips'"),
        (edit("JOINT Head", "JOINT"), "line 6", "a joint without a name"),
        (edit("OFFSET 1 2 3", "OFFSET 1 2"), "line 4", "2 values where 3 belong"),
        (edit("OFFSET 1 2 3", "OFFSET 1 2 nan"), "line 4", "'nan' (OFFSET) is not a finite number"),
        (edit("OFFSET 1 2 3", "OFFSET 1 2 3 4"), "line 4", "'4' where OFFSET, CHANNELS, JOINT"),
        (edit("OFFSET 1 2 3", "OFFSET 1 2 1e300"), "line 4", "'1e300' (OFFSET) is not a finite number"),
        (edit("  OFFSET 1 2 3\n", ""), "line 2", "joint 'Hips' has no OFFSET line"),
        (edit("OFFSET 1 2 3", "OFFSET 1 2 3\nOFFSET 1 2 3"), "line 5", "a second such line of joint 'Hips'"),
        (edit("    CHANNELS 3 Yrotation Zrotation Xrotation\n", ""), "line 6", "joint 'Head' has no CHANNELS line"),
        (edit("CHANNELS 3 Yrotation", "CHANNELS 3 Wrotation"), "line 9", "unknown channel 'Wrotation'; known: Xpos"),
        (edit("CHANNELS 3 Yrotation", "CHANNELS 3 Zrotation"), "line 9", "a channel twice"),
        (edit("CHANNELS 3", "CHANNELS 4"), "line 9", "3 values where 4 belong"),
        (edit("CHANNELS 3", "CHANNELS 999999999"), "line 9", "'999999999' channels; a joint has 0 to 6"),
        (edit("CHANNELS 3", "CHANNELS -1"), "line 9", "'-1' channels"),
        (edit("}\nMOTION", "MOTION"), "line 14", "the hierarchy ends inside joint 'Hips'; a '}' is missing"),
        (edit("}\nMOTION", "}\n}\nMOTION"), "line 16", "'}' outside the braces of a ROOT"),
        (edit("MOTION\n", ""), "line 16", "'Frames:' outside the braces of a ROOT"),
        (HEAD.partition("MOTION")[0], "line 16", "the file ends without a MOTION section"),
        (edit("Frames: 3\n", ""), "line 17", "'Frame Time: 0.05' where 'Frames: <count>' belongs"),
        (edit("Frames: 3", "Frames: three"), "line 17", "'three' frames"),
        (edit("Frames: 3", "Frames: 1"), "line 17", "'1' frames; a motion needs a count of at least two"),
        (edit("Frames: 3", "Frames: -3"), "line 17", "'-3' frames"),
        (edit("Frames: 3", "Frames: 2"), "line 17", "Frames says 2, but 3 lines of numbers follow"),
        (edit("Frames: 3", "Frames: 99999999999999999"), "line 17", "Frames says 99999999999999999, but 3 lines"),
        (edit("Frames: 3", "Frames: 9" + "9" * 30), "line 17", "a count of at least two"),
        (edit("Frame Time: 0.05\n", ""), "line 18", "where 'Frame Time: <seconds>' belongs"),
        (edit("0.05", "0"), "line 18", "Frame Time 0 is no positive time"),
        (edit("0.05", "-0.05"), "line 18", "Frame Time -0.05 is no positive time"),
        (edit("0.05", "1e-320"), "line 18", "is no positive time"),
        (edit("0.05", "nan"), "line 18", "'nan' is not a finite number"),
        (edit("0.05", "fast"), "line 18", "'fast' is not a finite number"),
        (HEAD, "line 19", "0 frames; a motion needs at least two"),
        (HEAD.partition("Frames")[0], "line 16", "'MOTION' where 'Frames: <count>' belongs"),
        (edit("1 90 0 0 0 10 0 0 0", "1 90 0 0 0 10 0 0"), "line 20", "8 numbers; the hierarchy has 9 channels"),
        (edit("1 90 0 0 0 10 0 0 0", "1 90 0 0 0 10 0 0 0 7"), "line 20", "10 numbers; the hierarchy has 9 channels"),
        (edit("1 90 0 0 0 10 0 0 0", "\n1 90 0 0 0 10 0 0"), "line 21", "8 numbers"),
        (edit("2 90 0 0 0 90 0 90 0\n", "2 90 0"), "line 21", "3 numbers; the hierarchy has 9 channels"),
        (edit("2 90 0", "2 9O 0"), "line 21, value 2", "'9O' (Yposition of 'Hips') is not a finite number"),
        (edit("90 0 90 0\n", "90 0 nan 0\n"), "line 21, value 8", "nan (Zrotation of 'Head')"),
        (edit("90 0 90 0\n", "90 0 -inf 0\n"), "line 21, value 8", "-inf (Zrotation of 'Head')"),
        (edit("90 0 90 0\n", "90 0 1e12 0\n"), "line 21, value 8", "1e+12 (Zrotation of 'Head') is no length or angle"),
        (edit("90 0 90 0\n", "90 0 9_0 0\n"), "line 21, value 8", "'9_0' (Zrotation of 'Head') is not a finite number"),
    ],
)  # fmt: skip
def test_malformed_files(tmp_path, text, where, reason):
    path = make(tmp_path, text)
    with pytest.raises(FormatError) as caught:
        read_bvh(path)
    assert caught.value.where == where and caught.value.path == path
    assert reason in str(caught.value)


def test_a_file_cut_anywhere_is_refused(tmp_path):
    whole = HEAD + ROWS
    for stop in range(0, len(whole.rstrip()) - 1, 3):
        with pytest.raises(FormatError):
            read_bvh(make(tmp_path, whole[:stop]))


def test_spoiled_bytes_are_read_or_refused(tmp_path):
    rng, whole = np.random.default_rng(0), (HEAD + ROWS).encode()
    bad = [b"", b"\0", b"{", b"}", b"\n", b"\xff", b"-", b"nan", b"1e999", b"JOINT", b"OFFSET", b"9" * 400, b" 1 "]
    refused = 0
    for _ in range(250):
        at, size = rng.integers(len(whole)), rng.integers(4)
        path = make(tmp_path, whole[:at] + bad[rng.integers(len(bad))] + whole[at + size :])
        try:
            assert np.isfinite(read_bvh(path).pose()[0]).all()
        except FormatError:
            refused += 1
    assert 60 < refused < 250


def test_a_very_deep_hierarchy_is_no_problem(tmp_path):
    depth = 1500
    joint = "{\nOFFSET 0 1 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    head = "HIERARCHY\nROOT r" + "".join(f"{joint}JOINT j{n}\n" for n in range(depth)) + joint + "}\n" * (depth + 1)
    row = " ".join(["0"] * (3 * (depth + 1)))
    motion = read_bvh(make(tmp_path, f"{head}MOTION\nFrames: 2\nFrame Time: 1\n{row}\n{row}\n"))
    assert len(motion.joints) == depth + 1
