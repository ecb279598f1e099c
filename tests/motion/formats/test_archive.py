"""archive.py: arrays of an npz as numpy reads them; claims are checked against the file before memory is taken."""

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from kinetok.motion.formats import FormatError
from kinetok.motion.formats.archive import LIMIT, ZipArrays, read_member


def npy(shape: tuple, data: bytes, descr: str = "<f8") -> bytes:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": descr, "fortran_order": False, "shape": shape})
    return header.getvalue() + data


def test_arrays_are_those_numpy_reads(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "f": np.asfortranarray(np.arange(6).reshape(2, 3)), "s": np.array("x")}
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "x.npz", **arrays)
        back = ZipArrays(tmp_path / "x.npz")
        assert set(back) == set(arrays) and "a" in back and "b" not in back and len(back) == 3
        for key, value in arrays.items():
            np.testing.assert_array_equal(back[key], value)


@pytest.mark.parametrize(
    ("member", "reason"),
    [
        (npy((10**10, 156), b"\0" * 16), "claims shape"),
        (npy((3,), b"\0" * 16), "claims shape"),
        (npy((), b"abc", "|O"), "holds Python objects, which are never loaded"),
        (b"no numpy at all", "not an npy array"),
        (b"", "not an npy array"),
    ],
)
def test_members_that_lie(tmp_path, member, reason):
    path = tmp_path / "x.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("poses.npy", member)
    tracemalloc.start()
    with pytest.raises(FormatError, match=reason) as caught:
        ZipArrays(path)["poses"]
    assert caught.value.where == "poses" and tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def test_a_member_that_claims_gigabytes_is_not_read(tmp_path):
    path = tmp_path / "x.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("poses.npy", npy((2,), b"\0" * 16))
    data, size = bytearray(path.read_bytes()), LIMIT + 1
    directory = data.index(b"PK\x01\x02")
    data[directory + 24 : directory + 28] = struct.pack("<I", size)  # uncompressed size in the central directory
    path.write_bytes(data)
    with pytest.raises(FormatError, match=f"{size} bytes; arrays beyond {LIMIT} bytes are not read"):
        read_member(path, "poses.npy")


def test_cut_and_damaged_archives(tmp_path):
    path, rng = tmp_path / "x.npz", np.random.default_rng(0)
    np.savez_compressed(path, a=rng.random(50))
    whole = path.read_bytes()
    for end in range(0, len(whole), 29):
        path.write_bytes(whole[:end])
        with pytest.raises(FormatError, match="archive: damaged or cut off"):
            ZipArrays(path)
    refused = 0
    for _ in range(60):
        spoilt = bytearray(whole)
        spoilt[rng.integers(0, len(whole))] ^= 1 << rng.integers(0, 8)
        path.write_bytes(spoilt)
        try:
            dict(ZipArrays(path))
        except FormatError:
            refused += 1
    assert refused > 30
