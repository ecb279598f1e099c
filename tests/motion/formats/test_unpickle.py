"""unpickle.py: pickles of arrays read like pickle reads them; nothing else is built, called or trusted for a size."""

import collections
import contextlib
import os
import pickle
import pickletools
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from kinetok.motion.formats import FormatError
from kinetok.motion.formats.unpickle import load_dict, load_plain

HERE = Path("motion.pkl")
MOTION = {
    "fps": 30,
    "rate": np.float32(29.5),
    "frames": np.arange(12.0).reshape(3, 4),
    "small": np.arange(6, dtype=">f4").reshape(2, 3),
    "turned": np.asfortranarray(np.arange(6, dtype=np.int64).reshape(2, 3)),
    "flags": np.array([True, False]),
    "names": np.array(["left", "right"]),
    "none": np.zeros((0, 3)),
    "scalar": np.array(7),
    "rows": [[1.5, -2], (3, 2**70), [None, "text ü", b"\x00\xff"]],
    "nested": collections.OrderedDict(a={"b": 1}, c=[]),
}


def same(a, b) -> bool:
    if isinstance(b, np.ndarray | np.generic):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(b, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in b)
    if isinstance(b, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b and type(a) is type(b)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_what_pickle_writes_reads_back(protocol):
    shared = np.arange(3.0)
    data = pickle.dumps(MOTION | {"twice": [shared, shared]}, protocol)
    back = load_plain(data, HERE)
    assert same(back.pop("twice"), [shared, shared]) and same(back, MOTION)


def test_an_array_of_objects_is_a_list_or_the_object():
    objects = np.empty(2, dtype=object)
    objects[:] = [{"a": 1}, None]
    assert load_plain(pickle.dumps(objects), HERE) == [{"a": 1}, None]
    alone = np.array({"a": 1}, dtype=object)
    assert load_plain(pickle.dumps(alone), HERE) == {"a": 1}


class Run:
    """Pickles to a call."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize(
    ("made", "name"),
    [
        (lambda mark: Run(os.system, f"touch {mark}"), "system"),
        (lambda mark: Run(eval, f"open({str(mark)!r}, 'w')"), "eval"),
        (lambda mark: Run(open, str(mark), "w"), "open"),
        (lambda mark: Run(os.mkdir, str(mark)), "mkdir"),
        (lambda mark: collections.Counter("ab"), "collections.Counter"),
        (lambda mark: Path("."), "Path"),
    ],
)
def test_classes_and_calls_are_refused_and_nothing_runs(tmp_path, made, name, protocol):
    mark = tmp_path / "ran"
    data = pickle.dumps({"frames": np.zeros((2, 3)), "x": made(mark)}, protocol)
    with pytest.raises(FormatError, match=r"motion.pkl: pickle, byte \d+: the class '.*is not plain data") as caught:
        load_plain(data, HERE)
    assert name in str(caught.value) and not mark.exists()


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (b"cos\nsystem\n(S'echo'\ntR.", "posix|os.system"),
        (b"(ios\nsystem\n.", "instruction INST has no place"),
        (b"(cos\nsystem\no.", "instruction OBJ has no place"),
        (b"\x82\x01.", "instruction EXT1 has no place"),
        (b"\x80\x02U\x01aQ.", "refers to data outside the pickle"),
        (b"\x80\x02cnumpy\nndarray\n}b.", "a state is set on a Named"),
        (b"\x80\x02]]b.", "a state is set on a list"),
        (b"\x80\x02}]K\x01s.", "keys that are not text or numbers"),
        (b"\x80\x02}K\x01a.", "added to a dict"),
        (b"\x80\x02cnumpy\ndtype\nU\x02O8\x85R.", "Kind"),
        (b"", "damaged or cut off"),
        (b"\x80\x02K\x01K\x02.", "damaged or cut off"),
        (b"\x80\x02h\x07.", "damaged or cut off"),
        (b"\x80\x02t.", "damaged or cut off"),
        (b"GIF89a", "damaged or cut off"),
    ],
)
def test_programs_by_hand(tmp_path, program, reason):
    path = tmp_path / "x.pkl"
    path.write_bytes(program)
    with pytest.raises(FormatError, match=reason.split("|")[-1]) as caught:
        load_dict(path)
    assert caught.value.path == path or "Kind" in reason


def claim(shape: tuple) -> bytes:
    """A pickle of an array of 16 bytes that says it has another shape."""
    data = pickle.dumps(np.zeros(2), 2)
    at = next(position for op, arg, position in pickletools.genops(data) if op.name == "BININT1" and arg == 2)
    return data[:at] + pickle.dumps(shape, 2)[2:-1].replace(b"\x85", b"").split(b"q\x00")[0] + data[at + 2 :]


@pytest.mark.parametrize(
    "data",
    [
        claim((10**11,)),
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n\x8a\x06\x00\x00\x00\x00\x00\x10\x85U\x01b\x87R.",
        b"\x80\x02K\x01r\xff\xff\xff\xff.",
        b"\x80\x04B\xff\xff\xff\x7fabc.",
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\x00\x00\x00abc.",
        b"\x80\x05\x96\xff\xff\xff\xff\xff\x00\x00\x00abc.",
        b"\x80\x04\x95\xff\xff\xff\xff\xff\x00\x00\x00N.",
    ],
)
def test_claims_of_size_take_no_memory(data):
    tracemalloc.start()
    with contextlib.suppress(FormatError):
        load_plain(data, HERE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000


def test_the_claimed_shape_is_named():
    with pytest.raises(FormatError, match=r"claims shape \(100000000000,\) of float64; the pickle holds 16 bytes"):
        load_plain(claim((10**11,)), HERE)


def test_every_cut_and_many_damages_are_format_errors():
    data, rng = (
        pickle.dumps({"fps": 30, "frames": np.arange(6.0), "names": ["a", ("b", 2)]}, 4),
        np.random.default_rng(0),
    )
    for end in range(len(data)):
        with pytest.raises(FormatError):
            load_plain(data[:end], HERE)
    for _ in range(2000):
        spoilt = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            spoilt[at] = rng.integers(0, 256)
        try:
            load_plain(bytes(spoilt), HERE)
        except FormatError as error:
            assert error.path == HERE


def test_a_motion_is_a_dict(tmp_path):
    path = tmp_path / "list.pkl"
    path.write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(FormatError, match="holds a list; a motion is a dict"):
        load_dict(path)
