"""library.py and part.py: files round-trip, frames stay on disk, growing, mirroring, splitting, sampling, messages."""

import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from kinetok import rotation
from kinetok.motion.clip import quaternion_columns
from kinetok.motion.error import FormatError
from kinetok.motion.formats import read_clips
from kinetok.motion.library import ClipLibrary
from kinetok.motion.part import decode, encode


@pytest.fixture
def path(tmp_path, walk, getup):
    path = tmp_path / "new" / "clips.safetensors"
    ClipLibrary.write(path, [walk, getup])
    return path


def test_round_trip(path, walk, getup):
    library = ClipLibrary.open(path)
    assert (library.character, library.names, len(library)) == ("humanoid", (walk.name, getup.name), 2)
    np.testing.assert_allclose(library.seconds, [walk.seconds, getup.seconds])
    for back, clip in zip(read_clips(path), (walk, getup), strict=True):
        assert (back.name, back.fps, back.loop, back.source) == (clip.name, clip.fps, clip.loop, clip.source)
        np.testing.assert_allclose(back.qpos, clip.qpos, atol=1e-6)
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # no temporary file is left


def test_at_equals_the_clips(path, walk, getup):
    library = ClipLibrary.open(path)
    rng = np.random.default_rng(0)
    ids, times = rng.integers(0, 2, 200), rng.uniform(-1, 4, 200)
    times[:4], ids[:4] = [0.0, walk.seconds, 2 * walk.seconds, getup.seconds], [0, 0, 0, 1]
    got = library.at(ids, times)
    assert got.dtype == np.float32
    for index, clip in enumerate((walk, getup)):
        np.testing.assert_allclose(got[ids == index], clip.at(times[ids == index]), atol=2e-5)


def test_frames_are_mapped_not_read(path):
    frames = ClipLibrary.open(path).frames
    assert not frames.flags.owndata and not frames.flags.writeable
    raw = bytearray(path.read_bytes())
    first = raw.index(frames[-1].tobytes())
    raw[first : first + 4] = np.float32(7.0).tobytes()
    with path.open("r+b") as file:
        file.write(raw)
    tail = [frames[-1, 0], ClipLibrary.open(path).frames[-1, 0]]
    assert tail[0] == tail[1] == 7.0  # the open library sees what the file holds now


def test_the_file_is_plain_safetensors(path, walk, getup):
    tensors = load_file(path)
    assert tensors["qpos"].shape == (len(walk.qpos) + len(getup.qpos), 43)
    assert tensors["starts"].tolist() == [0, len(walk.qpos)] and tensors["loop"].tolist() == [1, 0]
    assert json.loads(tensors["names"].tobytes()) == [walk.name, getup.name]


def test_files_of_the_first_version_open(tmp_path, walk):
    tensors = {"qpos": walk.qpos.astype(np.float32), "starts": np.array([0]), "lengths": np.array([len(walk.qpos)])}
    tensors |= {"fps": np.array([walk.fps]), "loop": np.array([1], np.uint8)}
    metadata = {"kind": "clips", "character": "humanoid", "names": '["walk"]', "sources": '["walk.txt"]'}
    save_file(tensors, tmp_path / "old.safetensors", metadata)
    (clip,) = read_clips(tmp_path / "old.safetensors")
    assert (clip.name, clip.source, clip.fps, clip.loop) == ("walk", "walk.txt", walk.fps, True)


def test_windows_equal_single_times(path, walk, getup):
    library, rng = ClipLibrary.open(path), np.random.default_rng(1)
    ids = rng.integers(0, 2, 50)
    times = rng.uniform(-1, 4, (50, 1)) + np.arange(6) / 30
    once = library.at(np.repeat(ids, 6), times.ravel()).reshape(50, 6, -1)
    np.testing.assert_allclose(library.at(ids, times), once, atol=1e-6)
    np.testing.assert_allclose(ClipLibrary.of([walk, getup]).at(ids, times), once, atol=1e-6)


def test_halves_keep_the_root_precise(tmp_path, walk, humanoid):
    far = walk.qpos.copy()
    far[:, :2] += [150.0, -90.0]
    rows = decode(encode(far, "float16"), "humanoid")
    assert encode(far, "float16").nbytes == len(far) * 92
    assert np.abs(rows[:, :3] - far[:, :3]).max() < 1e-4
    assert np.abs(rows[:, 7:] - far[:, 7:]).max() < 1e-3
    columns = quaternion_columns(humanoid)[:, None] + np.arange(4)
    np.testing.assert_allclose(np.linalg.norm(rows[:, columns], axis=-1), 1, atol=1e-6)
    apart = rotation.multiply(rotation.conjugate(far[:, columns]), rows[:, columns].astype(float))
    assert np.linalg.norm(rotation.to_rotvec(apart), axis=-1).max() < 1e-3
    ClipLibrary.write(tmp_path / "far.safetensors", [replace(walk, qpos=far)], dtype="float16")
    library = ClipLibrary.open(tmp_path / "far.safetensors")
    np.testing.assert_allclose(library.clip(0).qpos, rows, atol=1e-6)
    np.testing.assert_allclose(library.at(np.array([0]), np.array([0.4])), walk_at(walk, far, 0.4), atol=1e-3)
    far[3, 0] = 1e6
    with pytest.raises(ValueError, match=r"1e\+06 is too large for float16; write float32"):
        encode(far, "float16")


def walk_at(walk, qpos, time: float) -> np.ndarray:
    return replace(walk, qpos=qpos).at(np.array([time]))


def test_clips_may_be_a_stream(tmp_path, walk):
    ClipLibrary.write(tmp_path / "many.safetensors", (replace(walk, name=f"w{i}") for i in range(5)))
    assert ClipLibrary.open(tmp_path / "many.safetensors").names == ("w0", "w1", "w2", "w3", "w4")

    def breaks():
        yield walk
        raise RuntimeError("the source is gone")

    with pytest.raises(RuntimeError):
        ClipLibrary.write(tmp_path / "many.safetensors", breaks())
    assert len(ClipLibrary.open(tmp_path / "many.safetensors")) == 5
    assert [p.name for p in tmp_path.iterdir()] == ["many.safetensors"]


@pytest.mark.parametrize("name", ["grows.safetensors", "grows"])
def test_append(tmp_path, walk, getup, name):
    path = tmp_path / name
    ClipLibrary.append(path, [walk], dtype="float16")
    ClipLibrary.append(path, iter([getup, replace(walk, name="third")]))
    library = ClipLibrary.open(path)
    assert library.names == (walk.name, getup.name, "third") and library.parts[-1].frames.dtype == np.float16
    assert len(library.parts) == (1 if path.suffix else 2)
    ids = np.array([2, 0, 1, 2])
    got = library.at(ids, np.array([0.3, 0.3, 0.2, 5.0]))
    np.testing.assert_array_equal(got[0], got[1])
    np.testing.assert_allclose(got[2], getup.at(np.array([0.2]))[0], atol=2e-3)
    assert library.clip(-1).name == "third"
    assert [clip.name for clip in read_clips(path)] == list(library.names)
    assert list(tmp_path.rglob(".*")) == []


def test_two_writers_append_at_once(tmp_path, walk):
    def add(name: str) -> None:
        ClipLibrary.append(tmp_path / "grows", [replace(walk, name=name)])

    add("first")
    threads = [threading.Thread(target=add, args=(f"w{i}",)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(ClipLibrary.open(tmp_path / "grows").names) == ["first", "w0", "w1", "w2", "w3", "w4", "w5"]


def test_mirrored_on_the_fly(path, walk, getup):
    library = ClipLibrary.open(path, mirror=True)
    assert len(library) == 4 and library.names[2:] == ("walk-mirrored", f"{getup.name}-mirrored")
    assert library.sources[2:] == library.sources[:2] and len(library.seconds) == 4
    mirrored = walk.mirror()
    np.testing.assert_allclose(library.clip(2).qpos, mirrored.qpos, atol=1e-6)
    times = np.array([0.1, 0.5, 3.0])
    np.testing.assert_allclose(library.at(np.array([2, 2, 2]), times), mirrored.at(times), atol=2e-5)
    drawn = library.sample(4000, None, np.random.default_rng(0))
    frames = np.array([len(walk.qpos), len(getup.qpos)] * 2)
    np.testing.assert_allclose(np.bincount(drawn, minlength=4) / 4000, frames / frames.sum(), atol=0.03)


def test_split_by_source(walk):
    clips = [replace(walk, name=f"{s}-{i}", source=f"take{s}.bvh") for s in range(40) for i in range(3)]
    library = ClipLibrary.of(clips)
    train, held = library.split(held_out=0.25, seed=1)
    assert len(train) + len(held) == 120 and 0.1 < len(held) / 120 < 0.4
    assert not set(train.sources) & set(held.sources)
    assert held.clip(1).name == held.names[1] and held.names[1] in library.names
    again = ClipLibrary.of(clips[30:]).split(held_out=0.25, seed=1)[1]
    assert set(again.names) == set(held.names) & {clip.name for clip in clips[30:]}  # sides do not depend on the others
    both = library.mirrored().split(held_out=0.25, seed=1)[1]
    assert len(both) == 2 * len(held) and set(both.sources) == set(held.sources)
    with pytest.raises(ValueError, match=r"held_out is 1\.5; it is a share between 0 and 1"):
        library.split(1.5)
    with pytest.raises(ValueError, match="no source of 1 falls to"):
        ClipLibrary.of([walk, walk]).split()


def test_subset(path):
    library = ClipLibrary.open(path)
    part = library.subset(np.array([1]))
    assert part.names == library.names[1:] and part.seconds == pytest.approx(library.seconds[1:])
    np.testing.assert_array_equal(part.at(np.array([0]), np.array([0.2])), library.at(np.array([1]), np.array([0.2])))
    with pytest.raises(IndexError, match="clips 0 to 2 of a library of 2"):
        library.at(np.array([0, 2]), np.zeros(2))


def test_sample_frequencies(library, tmp_path, walk, getup):
    for name in ("one.safetensors", "parts"):
        ClipLibrary.append(tmp_path / name, [walk])
        ClipLibrary.append(tmp_path / name, [getup, walk])
        grown = ClipLibrary.open(tmp_path / name)
        for some in (grown, grown.subset(np.array([2, 1, 0]))):
            share = np.bincount(some.sample(9000, None, np.random.default_rng(0)), minlength=3) / 9000
            np.testing.assert_allclose(share, some.lengths / some.lengths.sum(), atol=0.02)
    drawn = library.sample(20_000, np.array([1.0, 3.0]), np.random.default_rng(0))
    assert np.bincount(drawn, minlength=2)[1] / 20_000 == pytest.approx(0.75, abs=0.015)
    assert (library.sample(100, np.array([0.0, 1.0]), np.random.default_rng(0)) == 1).all()


def test_messages(tmp_path, walk):
    with pytest.raises(ValueError, match="a library needs at least one clip"):
        ClipLibrary.of([])
    other = replace(walk, name="other")
    object.__setattr__(other, "character", "robot")
    with pytest.raises(ValueError, match="one library holds one character; these clips are of humanoid, robot"):
        ClipLibrary.of([walk, other])
    foreign = tmp_path / "foreign.safetensors"
    save_file({"weights": np.zeros(3)}, foreign)
    with pytest.raises(FormatError, match=r"foreign\.safetensors: metadata: not a clip library"):
        ClipLibrary.open(foreign)
    foreign.write_bytes(b"no such thing")
    with pytest.raises(FormatError, match="header: not a readable safetensors file"):
        ClipLibrary.open(foreign)
    with pytest.raises(ValueError, match="dtype is 'float64'; a library stores float32 or float16"):
        ClipLibrary.write(foreign, [walk], dtype="float64")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="3 weights for a library of 1 clips"):
        ClipLibrary.of([walk]).sample(2, np.ones(3), np.random.default_rng(0))
    with pytest.raises(FormatError, match="folder: holds no part of a clip library"):
        (tmp_path / "empty").mkdir()
        ClipLibrary.open(tmp_path / "empty")


SPOILED = [
    (
        {"lengths": np.array([400])},
        "clip 0: starts at frame 0, has 400; two at least, one clip behind the other, 39 in",
    ),
    ({"starts": np.array([-1])}, "clip 0: starts at frame -1"),
    ({"lengths": np.array([1])}, "clip 0: starts at frame 0, has 1; two at least"),
    ({"fps": np.array([0.0])}, "clip 0: fps is 0.0; it must be positive"),
    ({"fps": np.array([30.0, 30.0])}, r"starts: the index has \[1, 2\] rows"),
    ({"qpos": np.zeros((39, 12), np.float32)}, "qpos: 12 columns; 'humanoid' needs 43"),
    ({"qpos": np.zeros((39, 43))}, "qpos: F64 of shape"),
    ({"names": np.frombuffer(b"[1]", np.uint8)}, "names: needs a list of 1 texts, one per clip"),
    ({"qpos": np.zeros((39, 43), np.float32)}, "clip 0: quaternion at index"),
    ({"qpos": np.full((39, 43), np.nan, np.float32)}, "clip 0: quaternion at index"),
]


@pytest.mark.parametrize(("change", "message"), SPOILED)
def test_a_spoiled_index_is_refused(tmp_path, walk, change, message):
    path = tmp_path / "spoiled.safetensors"
    ClipLibrary.write(path, [walk])
    save_file(load_file(path) | change, path, {"kind": "clips", "character": "humanoid"})
    with pytest.raises(FormatError, match=message):
        read_clips(path)


def test_a_place_may_be_a_string(path, walk, getup, tmp_path):
    own = f"{tmp_path}/own/clips.safetensors"
    ClipLibrary.write(own, [walk])
    ClipLibrary.append(own, [getup])
    assert ClipLibrary.open(own).names == ClipLibrary.open(path).names
    assert [clip.name for clip in read_clips(own)] == [walk.name, getup.name]
