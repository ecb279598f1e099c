"""Arrays inside zip archives (npz, torch's), read one by one, none larger than the file says and we allow.

    arrays = ZipArrays(Path("walk_poses.npz"))       # reads the index
    poses = arrays["poses"]                          # reads that array

A zip member's header is checked against its size before memory is taken for it. Refused: damaged or cut archives,
arrays of Python objects, arrays beyond LIMIT bytes.
"""

import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from kinetok.motion.error import FormatError

LIMIT = 2**29  # bytes of one array: an hour of SMPL-X poses at 120 fps
MAGIC = b"\x93NUMPY"
BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, KeyError, OSError, SyntaxError)
BABBLE = (tokenize.TokenError, TypeError, IndexError, RecursionError, MemoryError)  # numpy parses headers as Python


class ZipArrays(Mapping[str, np.ndarray]):
    """The arrays of an npz file by name; each is read when it is asked for."""

    def __init__(self, path: Path):
        self.path = path
        self.members = {name.removesuffix(".npy"): name for name in member_names(path) if name.endswith(".npy")}

    def __getitem__(self, key: str) -> np.ndarray:
        data = read_member(self.path, self.members[key])
        start, shape, fortran, dtype = parse_header(self.path, key, data)
        if dtype.hasobject:
            raise FormatError(self.path, key, "holds Python objects, which are never loaded; save it as numbers")
        if math.prod(shape) * dtype.itemsize != len(data) - start:
            raise FormatError(self.path, key, f"claims shape {shape} of {dtype}; it holds {len(data) - start} bytes")
        return np.frombuffer(data, dtype, offset=start).reshape(shape, order="F" if fortran else "C")

    def __contains__(self, key: object) -> bool:
        return key in self.members

    def __iter__(self) -> Iterator[str]:
        return iter(self.members)

    def __len__(self) -> int:
        return len(self.members)


def member_names(path: Path) -> list[str]:
    """Names of the files in an archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except BROKEN as error:
        raise FormatError(path, "archive", f"damaged or cut off: {error}") from None


def read_member(path: Path, name: str) -> bytes:
    """One file of an archive, whole."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = archive.getinfo(name).file_size
            if size > LIMIT:
                raise FormatError(path, name, f"{size} bytes; arrays beyond {LIMIT} bytes are not read")
            with archive.open(name) as file:
                data = file.read(size)
    except FormatError:
        raise
    except BROKEN as error:
        raise FormatError(path, name, f"damaged or cut off: {error}") from None
    if len(data) != size:
        raise FormatError(path, name, f"cut off: {len(data)} of {size} bytes")
    return data


def parse_header(path: Path, where: str, data: bytes) -> tuple[int, tuple, bool, np.dtype]:
    """Of an npy file: where its data begins, shape, Fortran order, dtype."""
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
    except (*BROKEN, *BABBLE) as error:
        raise FormatError(path, where, f"not an npy array: {error}") from None
    return file.tell(), shape, fortran, dtype
