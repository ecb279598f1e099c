"""Every reader under mutated files: it reads them or raises FormatError with file and place; nothing else, and soon.

The short form runs with the tests. The long one, `make fuzz`, takes KINETOK_FUZZ inputs over all readers and other
random numbers each time. An input is a valid small file and a few mutations of its bytes, its words and lines, the
parts of its container or the values it was made from. It fails by any other exception, by 5 s of computing or by
taking a gigabyte.
"""

import io
import json
import os
import pickle
import re
import resource
import signal
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kinetok import rotation
from kinetok.motion.clip import Clip
from kinetok.motion.formats import FORMATS, FormatError, read, read_file, write_bvh, write_robot_csv
from kinetok.motion.formats.g1 import load_g1
from kinetok.motion.formats.robot_csv import DIALECTS
from kinetok.motion.kinematics import kinematics
from kinetok.motion.library import ClipLibrary
from kinetok.motion.skeleton import SkeletonMotion

INPUTS = int(os.environ.get("KINETOK_FUZZ", "100000"))
SHORT = 12  # inputs of each sample in the short form
COMPUTING, MEMORY = 5.0, 2**30  # seconds of the processor, bytes
WORDS = [b"nan", b"inf", b"-Infinity", b"-1", b"0", b"1e308", b"-1e308", b"1e-320", b"1e999", b"9" * 20, b"9" * 5000]
WORDS += [b"", b"x", b"1_0", b"0x1f", "\u0663".encode(), b"\x00", b"true", b"null", b"{}", b"[", b"]", b'"', b"{", b"}"]
WORDS += [b"\n", b"\r", b"\xff\xfe", b",", b":", b"0.5", b"Xposition", b"End", b"root", b"[" * 100_000, b"65536"]


@dataclass(frozen=True)
class Sample:
    """format: its name in FORMATS; files: names and bytes, the motion first; target: the file that is mutated; data and
    build: the values the file was made from and how, where they can be mutated too."""

    format: str
    files: dict[str, bytes]
    target: str
    data: dict | None = None
    build: Callable[[dict], bytes] | None = None


def deepmimic() -> dict:
    rows = np.zeros((4, 44))
    rows[:, [4, 8, 12, 16, 21, 25, 30, 35, 39]] = 1.0
    rows[:, 0], rows[:, 1], rows[:, 2] = 0.05, np.arange(4) / 20, 0.9
    return {"Loop": "none", "Frames": rows.tolist()}


ASF = """:version 1.10
:units
  length 0.5
  angle deg
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
    name shin
    direction 0 -1 0
    length 7
    axis 0 0 0 XYZ
    dof rx
  end
:hierarchy
  begin
    root thigh
    thigh shin
  end
"""
AMC = """:FULLY-SPECIFIED
:DEGREES
1
root 1 16 3 0 0 0
thigh 0 0
shin 0
2
root 1 16 3 90 0 90
thigh 90 0
shin 0
"""


def skeleton() -> SkeletonMotion:
    local = rotation.from_rotvec(np.random.default_rng(0).uniform(-0.5, 0.5, (3, 4, 3)))
    return SkeletonMotion(
        name="made",
        fps=60.0,
        joints=("Hips", "Spine", "Head", "LeftLeg"),
        parents=(-1, 0, 1, 0),
        offsets=np.array([[0, 0, 0], [0, 0, 0.5], [0, 0, 0.3], [0, 0.1, -0.8]]),
        local=local,
        root=np.tile([0.0, 0.0, 0.9], (3, 1)),
    )


def poselib() -> dict:
    motion = skeleton()
    pack = {"rotation": motion.local[..., [1, 2, 3, 0]], "root_translation": motion.root}
    tree = {"parent_indices": np.array(motion.parents), "local_translation": motion.offsets}
    return {
        **{key: {"arr": value.astype(np.float32)} for key, value in pack.items()},
        "skeleton_tree": {"node_names": list(motion.joints)} | {key: {"arr": value} for key, value in tree.items()},
        "is_local": True,
        "fps": np.array(60, dtype=np.int32),
    }


def amass(stage: int) -> dict:
    joints = np.random.default_rng(0).uniform(-0.3, 0.3, (4, 156 if stage == 1 else 165))
    common = {"poses": joints, "trans": np.tile([0.0, 0.0, 0.95], (4, 1)), "betas": np.zeros(16), "gender": "neutral"}
    return common | {"mocap_framerate" if stage == 1 else "mocap_frame_rate": np.array(120.0)}


def npz(data: dict) -> bytes:
    file = io.BytesIO()
    np.savez(file, **data)
    return file.getvalue()


def npy(data: dict) -> bytes:
    file = io.BytesIO()
    np.save(file, np.array(data, dtype=object), allow_pickle=True)
    return file.getvalue()


def motion_file(data: dict) -> bytes:
    file = io.BytesIO()
    torch.save({k: torch.tensor(v) if getattr(v, "dtype", None) in TENSORS else v for k, v in data.items()}, file)
    return file.getvalue()


TENSORS = [np.dtype(name) for name in ("f2", "f4", "f8", "i4", "i8", "bool")]


@pytest.fixture(scope="module")
def samples(squat, tmp_path_factory) -> list[Sample]:
    folder = tmp_path_factory.mktemp("samples")
    few = slice(0, 6)
    state = kinematics(load_g1("g1"), squat.qpos[few], 30.0)
    clip = Clip(name="squat", character="g1", fps=30.0, qpos=squat.qpos[few])
    made = []

    def text(kind: str, name: str, content: bytes | str) -> None:
        content = content if isinstance(content, bytes) else content.encode()
        made.append(Sample(kind, {name: content}, name))

    text("DeepMimic", "walk.txt", json.dumps(deepmimic()))
    for dtype in ("float32", "float16"):
        ClipLibrary.write(folder / "l.safetensors", [clip, clip.mirror()], dtype=dtype)  # type: ignore[arg-type]
        text("kinetok", "l.safetensors", (folder / "l.safetensors").read_bytes())
    write_bvh(folder / "a.bvh", skeleton())
    text("BVH", "a.bvh", (folder / "a.bvh").read_bytes())
    pair = {"leg_01.amc": AMC.encode(), "leg.asf": ASF.encode()}
    made.extend(Sample("ASF/AMC", pair, target) for target in pair)
    for dialect, shape in DIALECTS.items():
        write_robot_csv(folder / "a.csv", replace(clip, fps=shape.fps), dialect=dialect)
        text("Unitree G1", "a.csv", (folder / "a.csv").read_bytes())

    def values(kind: str, name: str, data: dict, build: Callable[[dict], bytes]) -> None:
        made.append(Sample(kind, {name: build(data)}, name, data, build))

    values("AMASS", "a_poses.npz", amass(1), npz)
    values("AMASS", "a_stageii.npz", amass(2), npz)
    body = {"joint_pos": squat.joints[few], "body_pos_w": state.xpos, "body_quat_w": state.xquat}
    values("mjlab", "m.npz", body | {"fps": np.array([50])}, npz)
    robot = {"root_pos": squat.root[few], "root_rot": squat.xyzw[few], "dof_pos": squat.joints[few]}
    values("GMR", "g.pkl", robot | {"fps": 30}, pickle.dumps)
    for width in (28, 29):
        frames = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 6 + width))
        values("MimicKit", "k.pkl", {"loop_mode": 0, "fps": 30, "frames": frames}, pickle.dumps)
        values("MimicKit", "k.pkl", {"loop_mode": 1, "fps": 30, "frames": frames.tolist()}, pickle.dumps)
    rigid = {"rigid_body_pos": state.xpos, "rigid_body_rot": state.xquat[..., [1, 2, 3, 0]], "fps": 30}
    values("ProtoMotions", "p.motion", rigid | {"dof_pos": squat.joints[few].astype(np.float32)}, motion_file)
    values("poselib (AMP)", "a.npy", poselib(), npy)
    return made


# Mutations: each takes the bytes (or the value), a place in [0, 1) and a number.


def spoil_bytes(data: bytes, where: float, what: int) -> bytes:
    at, kind, what = int(where * len(data)), what % 7, what // 7
    reach = at + 1 + what % 40
    if kind == 0:
        return data[:at] + bytes([what % 256]) + data[at + 1 :]
    if kind == 1:
        return data[:at] + bytes([data[at] ^ (1 << what % 8)]) + data[at + 1 :] if data else data
    if kind == 2:
        return data[:at] + WORDS[what % len(WORDS)] + data[at:]
    if kind == 3:
        return data[:at] + data[reach:]
    if kind == 4:
        return data[:at] + data[at:reach] * (2 + what % 3) + data[reach:]
    if kind == 5:
        return data[:at]
    other = what * 7919 % (len(data) + 1)
    return data[:at] + data[other : other + 8] + data[at + 8 :]


def spoil_words(data: bytes, where: float, what: int) -> bytes:
    """Another word for one word, or words and lines left out, doubled or exchanged."""
    kind, what = what % 6, what // 6
    words = re.split(rb"([\s,:\[\]{}\"]+)" if kind < 4 else rb"(\n)", data)
    at = int(where * ((len(words) + 1) // 2)) * 2
    if kind < 2:
        words[at] = WORDS[what % len(WORDS)]
    elif kind in (2, 4):
        words[at : at + 2] = []
    elif kind == 3:
        words[at:at] = words[at : at + 2]
    else:
        other = what % ((len(words) + 1) // 2) * 2
        words[at], words[other] = words[other], words[at]
    return b"".join(words)


def spoil_part(data: bytes, where: float, what: int) -> bytes:
    """Inside a container, whose sizes and checksums then fit again: a member of a zip, the header of safetensors."""
    change = spoil_words if what % 2 else spoil_bytes
    if data[:2] != b"PK":
        size = int.from_bytes(data[:8], "little")
        if not 2 <= size <= len(data) - 8:
            return change(data, where, what // 2)
        header = change(data[8 : 8 + size].rstrip(), where, what // 2)
        return len(header).to_bytes(8, "little") + header + data[8 + size :]
    file = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(file, "w") as new:
            names = old.namelist()
            chosen = names[what // 2 % len(names)]
            for name in names:
                content = old.read(name)
                place = where if what % 3 else where * min(128 / max(len(content), 1), 1)  # a header is short
                new.writestr(name, change(content, place, what // 4) if name == chosen else content)
    except (zipfile.BadZipFile, ValueError, IndexError, OSError, EOFError, NotImplementedError):
        # An earlier mutation has broken the archive itself: mutate its bytes instead.
        return spoil_bytes(data, where, what)
    return file.getvalue()


def spoil_value(value: object, where: float, what: int) -> object:
    """Another value for one: odd numbers in an array, other types and shapes, other things."""
    others: list[object] = [
        None,
        "text",
        -1,
        0,
        1e308,
        float("nan"),
        2**70,
        True,
        {},
        [],
        b"bytes",
        [[1], [2, 3]],
        {1: 2},
    ]
    others += [np.zeros((0, 3)), np.zeros((2, 0)), np.array("x"), 1e-320, -0.0, [float("inf")] * 3, [[0.0] * 43] * 3]
    array = None
    with suppress(ValueError, OverflowError):  # rows of unlike length
        array = np.atleast_1d(value) if isinstance(value, np.ndarray | list | int | float) else None  # type: ignore
    if array is None or array.dtype.kind not in "iuf" or not array.size or what % 3 == 0:
        return others[what // 3 % len(others)]
    what //= 3
    if what % 2:
        numbers = [np.nan, np.inf, 1e308, -1e308, 1e-320, 0.0, -1.0, 1e9, 3.0]
        changed = array.astype(np.float64)
        changed.reshape(-1)[int(where * array.size)] = numbers[what // 2 % len(numbers)]
        return changed
    shapes = [array[:1], array[:0], array.T, array[..., None], array.reshape(-1), array * 0, array * 1e200, -array]
    kinds = [array.astype(kind) for kind in ("f2", ">f8", "i8", "?", "c16", "U8", "O")]
    forms = [np.asfortranarray(array), array.tolist(), np.repeat(array[None], 2, 0), array[::-1]]
    return [*shapes, *kinds, *forms][what // 2 % (len(shapes) + len(kinds) + len(forms))]


def spoil_values(data: dict, where: float, what: int) -> dict:
    """A copy with one field changed or left out; fields of dictionaries inside count."""
    keys = sorted(data)
    if not keys:
        return data
    key = keys[int(where * len(keys))]
    inner = where * len(keys) % 1
    if isinstance(data[key], dict) and data[key] and what % 5:
        return data | {key: spoil_values({str(k): v for k, v in data[key].items()}, inner, what)}
    if what % 11 == 10:
        return {k: v for k, v in data.items() if k != key}
    return data | {key: spoil_value(data[key], inner, what // 11)}


def mutate(sample: Sample, level: str, steps: list[tuple[float, int]]) -> dict[str, bytes]:
    data = sample.files[sample.target]
    if level == "values" and sample.data is not None and sample.build is not None:
        changed = sample.data
        for where, what in steps:
            changed = spoil_values(changed, where, what)
        with suppress(ValueError, TypeError, RuntimeError, OverflowError):  # what cannot be written cannot be read
            data = sample.build(changed)
    else:
        container = data[:2] == b"PK" or sample.target.endswith(".safetensors")
        change = spoil_bytes if level == "bytes" else spoil_part if container else spoil_words
        for where, what in steps:
            data = change(data, where, what)
    return sample.files | {sample.target: data}


class Hang(BaseException):
    """More computing than a small file may take; no reader can mistake it for an error of the file."""


@contextmanager
def bounded() -> Iterator[None]:
    """Little computing and little memory."""

    def hang(*_):
        raise Hang(f"more than {COMPUTING} s of computing")

    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGPROF, hang)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, limits[1]))
    signal.setitimer(signal.ITIMER_PROF, COMPUTING)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.signal(signal.SIGPROF, before)


def try_to_read(sample: Sample, files: dict[str, bytes], folder: Path) -> bool:
    """Whether the files are read; the readers' contract is asserted."""
    for name, content in files.items():
        (folder / name).write_bytes(content)
    path = folder / next(iter(files))
    (known,) = (known for known in FORMATS if known.name == sample.format)
    try:
        with bounded():
            found = read_file(path, known)
            known.sniff(path)
    except FormatError as error:
        assert error.path.name in files and error.where and path.parent.name in str(error), str(error)
        return False
    finally:
        for name in files:
            (folder / name).unlink()
    assert found and all(isinstance(m, Clip | SkeletonMotion) for m in found)
    return True


STEPS = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 2**31)), min_size=1, max_size=3)


def fuzz(sample: Sample, inputs: int, folder: Path, *, repeatable: bool) -> dict[str, int]:
    """Inputs tried and how many were read."""
    count = {"tried": 0, "read": 0}

    @settings(
        max_examples=inputs,
        deadline=None,
        database=None,
        derandomize=repeatable,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.sampled_from(("words", "values", "bytes")), STEPS)
    def one(level: str, steps: list[tuple[float, int]]) -> None:
        count["tried"] += 1
        count["read"] += try_to_read(sample, mutate(sample, level, steps), folder)

    one()
    return count


def test_every_format_has_a_sample_that_reads(samples, tmp_path):
    assert {sample.format for sample in samples} == {known.name for known in FORMATS}
    for sample in samples:
        assert try_to_read(sample, sample.files, tmp_path), sample.target
        for name, content in sample.files.items():
            (tmp_path / name).write_bytes(content)
        assert read(tmp_path / next(iter(sample.files))), sample.target  # by content
        for name in sample.files:
            (tmp_path / name).unlink()


@pytest.mark.filterwarnings("ignore")
def test_mutated_files_are_read_or_refused(samples, tmp_path):
    for sample in samples:
        fuzz(sample, SHORT, tmp_path, repeatable=True)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_many_mutated_files(samples, tmp_path):
    share = -(-INPUTS // len(samples))
    total = 0
    for sample in samples:
        count = fuzz(sample, share, tmp_path, repeatable=False)
        total += count["tried"]
        print(f"{sample.format} {sample.target}: {count['tried']} inputs, {count['read']} read", flush=True)
    print(f"{total} inputs")
