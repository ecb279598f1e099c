"""protomotions.py: files saved by torch.save as ProtoMotions' converters do it, read without torch."""

import enum
import os
import sys
import types
import zipfile

import numpy as np
import pytest
import torch

from kinetok import rotation
from kinetok.motion.formats import FormatError, SkeletonMotion, read, read_protomotions
from kinetok.motion.formats.g1 import load_g1
from kinetok.motion.formats.protomotions import SMPL
from kinetok.motion.kinematics import kinematics
from kinetok.motion.smpl import JOINTS as SMPL_JOINTS
from kinetok.motion.smpl import OFFSETS

RNG = np.random.default_rng(0)


def robot(squat) -> dict:
    """What convert_g1_csv_to_proto.py saves: RobotState.to_dict()."""
    motion = kinematics(load_g1("g1"), squat.qpos, 30.0)
    state = {
        "rigid_body_pos": motion.xpos,
        "rigid_body_rot": motion.xquat[..., [1, 2, 3, 0]],
        "rigid_body_vel": motion.linear,
        "rigid_body_ang_vel": motion.angular,
        "dof_pos": squat.joints,
        "dof_vel": motion.qvel[:, 6:],
    }
    data: dict = {key: torch.tensor(value, dtype=torch.float32) for key, value in state.items()}
    return data | {"fps": 30, "rigid_body_contacts": torch.zeros(len(squat.root), 30, dtype=torch.bool)}


def human(frames: int = 6) -> tuple[dict, SkeletonMotion]:
    """A motion of smpl_humanoid.xml's bodies, its hands a little beyond the wrists."""
    names = [name for name, _ in SMPL]
    hand = np.array([0.08, 0, 0])
    offsets = np.array([OFFSETS[SMPL_JOINTS.index(n)] if n in SMPL_JOINTS else hand for n in names])
    local = rotation.from_rotvec(RNG.uniform(-0.5, 0.5, (frames, 24, 3)))
    motion = SkeletonMotion(
        name="made",
        fps=30.0,
        joints=tuple(names),
        parents=tuple(names.index(parent) if parent else -1 for _, parent in SMPL),
        offsets=offsets,
        local=local,
        root=RNG.uniform(-1, 1, (frames, 3)),
    )
    pos, rot = motion.pose()
    data = {
        "rigid_body_pos": torch.tensor(pos, dtype=torch.float32),
        "rigid_body_rot": torch.tensor(rot[..., [1, 2, 3, 0]], dtype=torch.float32),
        "dof_pos": torch.zeros(frames, 69),
        "fps": torch.tensor(30.0),
    }
    return data, motion


def write(tmp_path, data):
    torch.save(data, tmp_path / "x.motion")
    return tmp_path / "x.motion"


def test_a_robot_reads_as_it_was_saved(tmp_path, squat):
    (clip,) = read(write(tmp_path, robot(squat)))
    assert (clip.name, clip.character, clip.fps, clip.source) == ("x", "g1", 30.0, "x.motion")
    np.testing.assert_allclose(clip.qpos, squat.qpos, atol=1e-6)


def test_views_of_shared_storage_read_right(tmp_path, squat):
    data = robot(squat)
    wide = torch.zeros(40, 58)
    wide[:, ::2] = data["dof_pos"]
    data["dof_pos"] = wide[:, ::2]
    data["rigid_body_pos"] = data["rigid_body_pos"].permute(2, 1, 0).contiguous().permute(2, 1, 0)
    np.testing.assert_allclose(read_protomotions(write(tmp_path, data)).qpos, squat.qpos, atol=1e-6)


def test_a_human_becomes_a_skeleton_with_measured_offsets(tmp_path):
    data, wanted = human()
    motion = read_protomotions(write(tmp_path, data))
    assert (motion.family, motion.fps, motion.joints) == ("smpl", 30.0, wanted.joints)
    np.testing.assert_allclose(motion.offsets, wanted.offsets, atol=1e-6)
    np.testing.assert_allclose(motion.pose()[0], wanted.pose()[0], atol=1e-5)
    assert set(SMPL_JOINTS) <= set(motion.joints)


def test_the_state_conversion_that_protomotions_saves_along_is_data(tmp_path, squat, monkeypatch):
    name = "protomotions.simulator.base_simulator.simulator_state"
    for end in range(1, name.count(".") + 2):
        part = ".".join(name.split(".")[:end])
        monkeypatch.setitem(sys.modules, part, types.ModuleType(part))
    kind = enum.Enum("StateConversion", {"COMMON": "common"}, module=name)
    sys.modules[name].StateConversion = kind  # type: ignore[attr-defined]
    path = write(tmp_path, robot(squat) | {"state_conversion": kind.COMMON})
    assert b"StateConversion" in path.read_bytes()
    monkeypatch.undo()
    assert len(read_protomotions(path).qpos) == 40


def shuffled(data: dict) -> dict:
    order = [0, 5, *range(1, 5), *range(6, 24)]
    return data | {key: data[key][:, order] for key in ("rigid_body_pos", "rigid_body_rot")}


@pytest.mark.parametrize(
    ("change", "where", "reason"),
    [
        (lambda d: {"fps": 30}, "rigid_body_pos", "is missing; the file holds: fps"),
        (lambda d: d | {"fps": torch.zeros(())}, "fps", "0.0 is no frame rate"),
        (lambda d: d | {"fps": None}, "fps", "is NoneType, not numbers"),
        (shuffled, "rigid_body_pos, frame", "not SMPL's order of bodies"),
        (
            lambda d: d | {key: d[key][:, :20] for key in ("rigid_body_pos", "rigid_body_rot")},
            "rigid_body_pos",
            "20 bodies and 69 degrees of freedom, and no names; known: 24 bodies",
        ),
        (lambda d: d | {"rigid_body_rot": d["rigid_body_rot"] * 0}, "rigid_body_rot[0, 0]", "norm 0 is no rotation"),
        (lambda d: d | {"rigid_body_pos": d["rigid_body_pos"] / 0}, "rigid_body_pos[0, 0, 0]", "is not a finite"),
        (lambda d: d | {"rigid_body_rot": d["rigid_body_rot"][1:]}, "rigid_body_rot", "the format has (6, 24, 4)"),
        (lambda d: [1, 2], "data.pkl", "holds a list; a motion is a dict of tensors"),
        (lambda d: d | {"x": torch.zeros(2, dtype=torch.bfloat16)}, "pickle", "torch.BFloat16Storage is not read"),
        (lambda d: d | {"x": torch.zeros(1).expand(2**30)}, "pickle", "does not fit its storage"),
        (lambda d: d | {"x": Trap()}, "pickle", "the class '"),
    ],
)
def test_malformed_files(tmp_path, change, where, reason):
    with pytest.raises(FormatError) as caught:
        read_protomotions(write(tmp_path, change(human()[0])))
    assert caught.value.where.startswith(where) and reason in str(caught.value)
    assert not Trap.sprung


class Trap:
    """Would run if it were unpickled."""

    sprung = False

    def __reduce__(self):
        return os.system, ("exit 1",)


def rewrite(path, change) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in change(members).items():
            archive.writestr(name, data)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda m: {n: d[: len(d) // 2] if n.endswith(".pkl") else d for n, d in m.items()}, "cut off"),
        (
            lambda m: {n: d[:8] if n.endswith("data/0") else d for n, d in m.items()},
            "claims 432 values; the file holds 2",
        ),
        (lambda m: {n: d for n, d in m.items() if not n.endswith("data/0")}, "x/data/0: damaged or cut off"),
        (lambda m: {n: d for n, d in m.items() if not n.endswith("data.pkl")}, "no data.pkl"),
        (lambda m: m | {"x/byteorder": b"big"}, "byteorder: is not little"),
    ],
)
def test_damaged_archives(tmp_path, change, reason):
    path = write(tmp_path, human()[0])
    rewrite(path, change)
    with pytest.raises(FormatError, match=reason):
        read_protomotions(path)


def test_a_truncated_file(tmp_path):
    path = write(tmp_path, human()[0])
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FormatError, match="archive: damaged or cut off"):
        read_protomotions(path)
