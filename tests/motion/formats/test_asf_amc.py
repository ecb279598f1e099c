"""asf_amc.py: the same trial as AMC and BVH is the same motion, by hand it is what the format says."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.error import FormatError
from kinetok.motion.formats.asf_amc import find_asf, read_amc, read_asf
from kinetok.motion.formats.bvh import read_bvh, write_bvh

# bones of 01.asf and the joints of the BVH that cgspeed made of it; both stand where the bone begins
SIDE = {
    "hipjoint": "{S}HipJoint", "femur": "{side}UpLeg", "tibia": "{side}Leg", "foot": "{side}Foot",
    "toes": "{side}ToeBase", "clavicle": "{side}Shoulder", "humerus": "{side}Arm", "radius": "{side}ForeArm",
    "wrist": "{side}Hand", "hand": "{side}FingerBase", "fingers": "{S}Fingers", "thumb": "{S}Thumb",
}  # fmt: skip
NAMES = {
    "root": "Hips", "lowerback": "LowerBack", "upperback": "Spine", "thorax": "Spine1", "lowerneck": "Neck",
    "upperneck": "Neck1", "head": "Head",
}  # fmt: skip
for letter, word in (("l", "Left"), ("r", "Right")):
    NAMES |= {letter + bone: name.format(S=letter.upper(), side=word) for bone, name in SIDE.items()}
# The BVH leaves out the length of thorax and wrists: what hangs from them begins where they do.
SHORTENED = {"lowerneck": "thorax", "lclavicle": "thorax", "rclavicle": "thorax"}
SHORTENED |= {f"{side}{bone}": f"{side}wrist" for side in "lr" for bone in ("hand", "thumb")}


@pytest.fixture(scope="module")
def amc(data_dir):
    return read_amc(data_dir / "amc" / "01_01_first600.amc")


@pytest.fixture(scope="module")
def bvh(data_dir):
    return read_bvh(data_dir / "amc" / "01_01_first600.bvh")


def test_amc_and_bvh_of_one_trial_turn_alike(amc, bvh):
    """Row 0 of the BVH is an added T-pose. Its angles have four decimals, the AMC's six figures: 2e-6 rad each."""
    assert set(NAMES) == set(amc.joints) and set(NAMES.values()) == set(bvh.joints)
    assert len(bvh.root) == len(amc.root) + 1 == 601
    local, world = amc.local, amc.pose()[1]
    bvh_local, bvh_world = bvh.local[1:], bvh.pose()[1][1:]
    for bone, name in NAMES.items():
        i, j = amc.joints.index(bone), bvh.joints.index(name)
        for ours, theirs, worst in ((local, bvh_local, 2e-6), (world, bvh_world, 6e-6)):
            apart = rotation.multiply(rotation.conjugate(ours[:, i]), theirs[:, j])
            assert np.linalg.norm(rotation.to_rotvec(apart), axis=-1).max() < worst, bone


def test_amc_and_bvh_of_one_trial_stand_alike(amc, bvh):
    """Positions equal to 1e-5 m, once the BVH is given the bones that it leaves out."""
    offsets = bvh.offsets.copy()
    for bone in SHORTENED:
        j = bvh.joints.index(NAMES[bone])
        np.testing.assert_array_equal(offsets[j], 0)
        offsets[j] = amc.offsets[amc.joints.index(bone)]
    np.testing.assert_allclose(
        [offsets[bvh.joints.index(name)] for name in NAMES.values()],
        [amc.offsets[amc.joints.index(bone)] for bone in NAMES],
        atol=4e-7,
    )
    positions, others = amc.pose()[0], replace(bvh, offsets=offsets).pose()[0][1:]
    for bone, name in NAMES.items():
        apart = positions[:, amc.joints.index(bone)] - others[:, bvh.joints.index(name)]
        assert np.linalg.norm(apart, axis=-1).max() < 1e-5, bone
    for bone in ("root", "lfemur", "ltoes", "rtoes", "thorax"):  # and as the BVH is, where nothing is left out
        apart = positions[:, amc.joints.index(bone)] - bvh.pose()[0][1:, bvh.joints.index(NAMES[bone])]
        assert np.linalg.norm(apart, axis=-1).max() < 1e-5, bone


def test_every_collected_file_reads(data_dir, tmp_path):
    for path in sorted((data_dir / "amc").glob("*.amc")):
        motion = read_amc(path)
        assert len(motion.joints) == 31
        assert (motion.family, motion.unit, motion.fps, motion.source) == ("cmu-asf", "cmu", 120, path.name)
        positions = motion.pose()[0]
        assert -0.02 < np.percentile(positions[..., 2].min(1), 5) < 0.1, path.name
        assert 0.8 < np.percentile(motion.root[:, 2], 90) < 1.25
        write_bvh(tmp_path / "copy.bvh", motion)
        again = read_bvh(tmp_path / "copy.bvh")
        assert (again.joints, again.family) == (motion.joints, "cmu-asf")
        np.testing.assert_allclose(again.pose()[0], positions, atol=1e-6)


ASF = """# a leg
:version 1.10
:name LEG
:units
  mass 1.0
  length 0.5
  angle deg
:documentation
  begin at the hip
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name thigh
    direction 0 -1 0
    length 8
    axis 0 0 90 XYZ
    dof rx rz
    limits (-10 10)
           (-20 20)
  end
  begin
    id 2
    name stub
    direction 1 0 0
    length 2
    axis 0 0 0 XYZ
  end
  begin
    id 3
    name shin
    direction 0 -1 0
    length 7
    axis 0 0 0 XYZ
    dof rx
  end
:hierarchy
  begin
    root stub thigh
    thigh shin
  end
"""
AMC = """#!OML:ASF leg.asf
:FULLY-SPECIFIED
:DEGREES
1
root 1 16 3 0 0 0
thigh 0 0
shin 0
2
root 1 16 3 90 0 90
thigh 90 0
shin 0
3
root 1 16 3 0 0 0
thigh 0 90
shin 90
"""
UNIT = 0.0254 / 0.5


def make(tmp_path, amc: str = AMC, asf: str = ASF) -> Path:
    (tmp_path / "leg.asf").write_text(asf)
    path = tmp_path / "leg_01.amc"
    path.write_text(amc)
    return path


def test_a_file_by_hand(tmp_path):
    motion = read_amc(make(tmp_path))
    assert (motion.joints, motion.parents) == (("root", "stub", "thigh", "shin"), (-1, 0, 0, 2))
    assert (motion.fps, motion.unit, motion.family) == (120, "2 in", "")
    np.testing.assert_allclose(motion.root, [[UNIT, -3 * UNIT, 16 * UNIT]] * 3)
    np.testing.assert_allclose(motion.offsets, [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, -8 * UNIT]], atol=1e-12)
    y_up = np.stack([motion.pose()[0][..., 0], motion.pose()[0][..., 2], -motion.pose()[0][..., 1]], axis=-1) / UNIT
    np.testing.assert_allclose(y_up[0, 3], [1, 8, 3], atol=1e-9)
    # Frame 2: the thigh's axis frame is turned 90 about z, so its rx is about the body's y and leaves the thigh; then
    # the root turns 90 about x, which takes -y to -z, then 90 about z, which leaves -z.
    np.testing.assert_allclose(y_up[1, 3], [1, 16, 3 - 8], atol=1e-9)
    # Frame 3: rz about z takes the thigh from -y to +x; the shin's rx is about the turned thigh's own x, the world's y.
    np.testing.assert_allclose(y_up[2, 3], [1 + 8, 16, 3], atol=1e-9)
    shin = rotation.to_matrix(motion.pose()[1][2, 3]) @ [0, 0, -1]  # z up: the shin's direction at rest
    np.testing.assert_allclose(shin, [0, 1, 0], atol=1e-9)  # away from +x, to the world's -z, which is y here


def test_radians_rates_and_frame_numbers(tmp_path):
    plain = read_amc(make(tmp_path))
    turns = AMC.replace(":DEGREES", ":RADIANS\n:SAMPLES-PER-SECOND 60").replace("90", f"{np.pi / 2:.15f}")
    motion = read_amc(
        make(tmp_path, turns.replace("\n3\n", "\n43\n").replace("\n2\n", "\n42\n").replace("\n1\n", "\n41\n"))
    )
    assert motion.fps == 60 and read_amc(tmp_path / "leg_01.amc", fps=30).fps == 30
    np.testing.assert_allclose(motion.local, plain.local, atol=1e-12)
    asf = ASF.replace("angle deg", "angle rad").replace("axis 0 0 90", f"axis 0 0 {np.pi / 2:.15f}")
    np.testing.assert_allclose(read_amc(make(tmp_path, asf=asf)).local, plain.local, atol=1e-12)
    crlf = make(tmp_path, AMC.replace("\n", "\r\n"), ASF.replace("\n", "\r\n"))
    np.testing.assert_array_equal(read_amc(crlf).local, plain.local)


def test_bones_may_come_in_any_order(tmp_path):
    lines = AMC.replace("thigh 0 90\nshin 90\n", "shin 90\nthigh 0 90\n")
    np.testing.assert_array_equal(read_amc(make(tmp_path, lines)).local, read_amc(make(tmp_path)).local)


def test_the_skeleton_beside_a_motion(data_dir, tmp_path):
    folder = data_dir / "amc"
    for motion, skeleton in (("01_01_first600", "01"), ("11_01", "11"), ("backflip", "backflip")):
        assert find_asf(folder / f"{motion}.amc") == folder / f"{skeleton}.asf"
    path = make(tmp_path)
    assert find_asf(path) == tmp_path / "leg.asf"
    assert find_asf(tmp_path / "other_07.amc") == tmp_path / "leg.asf"  # the only one
    shutil.copy(tmp_path / "leg.asf", tmp_path / "OTHER.ASF")
    assert find_asf(tmp_path / "other_07.amc") == tmp_path / "OTHER.ASF"
    with pytest.raises(
        FormatError, match=r"no 03_1\.asf or 03\.asf beside it \(2 other \.asf files there\); name its ASF"
    ):
        find_asf(tmp_path / "03_1.amc")
    assert read_asf(tmp_path / "leg.asf").metres == pytest.approx(UNIT)
    other = tmp_path / "elsewhere" / "x.amc"
    other.parent.mkdir()
    shutil.move(path, other)
    assert len(read_amc(other, tmp_path / "leg.asf").root) == 3


def edit(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("old", "new", "where", "reason"),
    [
        ("1\nroot", "root", "line 4", "'root 1 16 3 0 0 0' where a frame number belongs"),
        ("\n2\n", "\n4\n", "line 8", "frame 4 where frame 2 belongs"),
        ("\n2\n", "\n", "line 8", "'root' a second time in this frame"),
        ("shin 0\n2", "2", "line 4", "frame 1 gives no values of 'shin'"),
        ("shin 0\n", "shin 0 1\n", "line 7", "2 numbers of 'shin'; the ASF gives it 1"),
        ("shin 0\n", "foot 0\n", "line 7", "'foot' is no bone with degrees of freedom in the ASF"),
        ("shin 0\n", "stub 0\n", "line 7", "'stub' is no bone with degrees of freedom"),
        ("shin 90", "shin 9O", "line 15", "'9O' (shin) is not a finite number"),
        ("shin 90", "shin nan", "line 15", "'nan' (shin) is not a finite number"),
        ("shin 90", "shin 1e30", "line 15", "'1e30' (shin) is not a finite number"),
        (AMC, "", "line 1", "the file is empty"),
        (AMC[AMC.index("1\nroot") :], "", "line 3", "0 frames; a motion needs two"),
        (AMC[AMC.index("\n2\n") :], "", "line 7", "1 frames; a motion needs two"),
        (":DEGREES", ":DEGREES\n:SAMPLES-PER-SECOND 0", "line 4", "0 samples per second"),
        (":DEGREES", ":SAMPLES-PER-SECOND", "line 3", "'' is not a finite number"),
    ],
)
def test_malformed_motions(tmp_path, old, new, where, reason):
    path = make(tmp_path, edit(AMC, old, new))
    with pytest.raises(FormatError) as caught:
        read_amc(path)
    assert caught.value.where == where and caught.value.path == path and reason in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "where", "reason"),
    [
        (ASF, " ", "line 1", "the file is empty"),
        (":bonedata", ":bones", "sections", "no :bonedata"),
        (":bonedata", ":units", "line 15", "a second :units section"),
        ("length 0.5", "length 0", "line 6", "length 0 is not positive"),
        ("  length 0.5\n", "", "line 4", "units need a length"),
        ("angle deg", "angle grad", "line 7", "'angle grad': angles are 'deg' or 'rad'"),
        ("angle deg", "angle", "line 7", "'angle': angles are 'deg' or 'rad'"),
        ("order TX TY TZ RX RY RZ", "order TX TY TZ", "line 11", "the root's order is 'TX TY TZ'"),
        ("position 0 0 0", "position 0 1 0", "line 13", "the root's position is 0 1 0; only 0 0 0 is supported"),
        ("orientation 0 0 0", "orientation 0 x 0", "line 14", "'x' is not a finite number"),
        ("    name thigh\n", "", "line 16", "a bone's name takes 1 values; here are 0"),
        ("name thigh", "name root", "line 16", "two bones are named 'root'"),
        ("name stub", "name shin", "line 33", "two bones are named 'shin'"),
        ("length 8", "length 8\nlength 8", "line 21", "a second length of the bone that begins at line 16"),
        ("length 8", "length -8", "line 16", "a bone of -8"),
        ("direction 0 -1 0", "direction 0 -2 0", "line 16", "a direction of length 2"),
        ("direction 0 -1 0", "direction 0 -1", "line 19", "a bone's direction takes 3 values; here are 2"),
        ("axis 0 0 90 XYZ", "axis 0 0 90 XXZ", "line 21", "axis order 'XXZ'"),
        ("axis 0 0 90 XYZ", "axis 0 0 inf XYZ", "line 21", "'inf' is not a finite number"),
        ("dof rx rz", "dof rx tz", "line 22", "dof 'rx tz'; bones only turn"),
        ("dof rx rz", "dof rx rx", "line 22", "dof 'rx rx'"),
        ("id 2", "colour 2", "line 27", "unknown word 'colour' in a bone"),
        ("  end\n  begin\n    id 2", "    id 2", "line 26", "a second name of the bone that begins at line 16"),
        ("  begin\n    id 2", "    id 2", "line 26", "'id' where a bone's begin ... end belongs"),
        ("    dof rx\n  end\n", "    dof rx\n", "line 39", "the file ends inside a bone"),
        ("thigh shin\n", "thigh knee\n", "line 44", "'knee' is no bone of :bonedata"),
        ("thigh shin\n", "thigh stub\n", "line 44", "'stub' hangs from two bones"),
        ("root stub thigh", "shin stub thigh", "line 43", "'shin' has children but hangs from nothing yet"),
        ("    thigh shin\n", "", "line 33", "bone 'shin' is not in the :hierarchy"),
    ],
)  # fmt: skip
def test_malformed_skeletons(tmp_path, old, new, where, reason):
    path = make(tmp_path, asf=edit(ASF, old, new)).with_name("leg.asf")
    with pytest.raises(FormatError) as caught:
        read_asf(path)
    assert caught.value.where == where and caught.value.path == path and reason in str(caught.value)


def test_files_cut_anywhere_are_refused_or_whole(tmp_path):
    for stop in range(0, len(ASF) - 12, 7):
        with pytest.raises(FormatError):
            read_asf(make(tmp_path, asf=ASF[:stop]).with_name("leg.asf"))
    for stop in range(0, len(AMC), 5):
        path = make(tmp_path, AMC[:stop])
        try:
            assert len(read_amc(path).root) in (2, 3)
        except FormatError:
            assert stop < len(AMC) - 3
