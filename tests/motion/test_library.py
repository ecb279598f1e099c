"""library.py: files round-trip, frames stay on disk, sampling in proportion, messages."""

from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import save_file

from kinetok.motion.error import FormatError
from kinetok.motion.formats import read_clips
from kinetok.motion.library import ClipLibrary


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
    raw[-4:] = np.float32(7.0).tobytes()
    with path.open("r+b") as file:
        file.write(raw)
    tail = [frames[-1, -1], ClipLibrary.open(path).frames[-1, -1]]
    assert tail[0] == tail[1]  # the open library sees what the file holds now


def test_sample_frequencies(library):
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
