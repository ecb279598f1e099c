"""One file of a clip library: frames on disk, an index in front of them, written as a stream and read in pieces.

    write_part(path, clips, "float16")              # clips may be a generator; nothing is kept but the index
    part = open_part(path)                          # reads the header, checks the index, touches no frame
    rows = part.rows(first, count)                  # (sum(count), nq) float32, read, not mapped

The file is safetensors, written and read by hand so that neither needs its size in memory: the frames (F, nq) float32
as `qpos`, or as `qpos16` (F, nq + 3) float16, where the last three columns are what the halves of the root position
left over; starts, lengths, fps and loop (K,); names and sources as JSON bytes (in files of the first version: in the
metadata). Refused, naming file and key: other headers, an index that does not fit the frames.
"""

import functools
import json
import mmap
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from kinetok.motion.character import Character
from kinetok.motion.clip import Clip, quaternion_columns
from kinetok.motion.error import FormatError

Dtype = Literal["float32", "float16"]
HEADER = 4096  # bytes kept free for the header of a file that is written as a stream
LONGEST_HEADER = 100_000_000  # that of the safetensors library
LIMIT16 = 65504.0
CODES = {"F32": np.float32, "F16": np.float16, "I64": np.int64, "F64": np.float64, "U8": np.uint8}
INDEX = {"starts": "I64", "lengths": "I64", "fps": "F64", "loop": "U8"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """The clips of one file, or of memory: starts, lengths (K,) frames, fps (K,), loop (K,) bool or uint8;
    frames (F, nq) float32 or (F, nq + 3) float16, mapped when they are in a file; names and sources as JSON bytes."""

    character: str
    starts: np.ndarray = field(repr=False)
    lengths: np.ndarray = field(repr=False)
    fps: np.ndarray = field(repr=False)
    loop: np.ndarray = field(repr=False)
    frames: np.ndarray = field(repr=False)
    texts: tuple[bytes | np.ndarray, bytes | np.ndarray] = field(repr=False)
    path: Path | None = None
    file: BinaryIO | None = field(default=None, repr=False)
    map: mmap.mmap | None = field(default=None, repr=False)
    offset: int = 0

    def __len__(self) -> int:
        return len(self.lengths)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        return self._strings(0)

    @functools.cached_property
    def sources(self) -> tuple[str, ...]:
        return self._strings(1)

    def _strings(self, index: int) -> tuple[str, ...]:
        place, path = ("names", "sources")[index], self.path or Path("memory")
        try:
            found = json.loads(bytes(self.texts[index]))
        except ValueError as error:
            raise FormatError(path, place, f"not JSON: {error}") from None
        if not isinstance(found, list) or len(found) != len(self) or not all(isinstance(x, str) for x in found):
            raise FormatError(path, place, f"needs a list of {len(self)} texts, one per clip")
        return tuple(found)

    def entries(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """starts, lengths, fps and loop (bool) of clips ids (N,)."""
        starts, lengths, fps, loop = (
            self._take(column, ids) for column in (self.starts, self.lengths, self.fps, self.loop)
        )
        return starts, lengths, fps, loop.astype(bool)

    def _take(self, column: np.ndarray, ids: np.ndarray) -> np.ndarray:
        found = column[ids]
        self.forget()
        return found

    def drawn(self, frames: np.ndarray) -> np.ndarray:
        """The clips (N,) to which frames (N,) of the part belong."""
        found = np.searchsorted(self.starts, frames, side="right") - 1
        self.forget()
        return found

    def forget(self) -> None:
        """Let go of the index's pages, so that memory does not grow with the clips looked at; they come back by
        themselves."""
        if self.map is not None:
            self.map.madvise(mmap.MADV_DONTNEED)

    def rows(self, first: np.ndarray, count: np.ndarray) -> np.ndarray:
        """Rows first[i] .. first[i] + count[i] - 1 for every i, one after the other, as float32 (sum(count), nq)."""
        total = int(count.sum())
        if self.file is None:
            begin = np.repeat(first - np.cumsum(count) + count, count)
            return decode(self.frames[begin + np.arange(total)], self.character)
        out = np.empty((total, self.frames.shape[1]), self.frames.dtype)
        width, at, bytes_out = out.strides[0], 0, out.reshape(-1).view(np.uint8).data
        descriptor, offset = self.file.fileno(), self.offset
        for begin, size in zip((first * width + offset).tolist(), (count * width).tolist(), strict=True):
            if os.preadv(descriptor, [bytes_out[at : at + size]], begin) != size:
                raise FormatError(self.path or Path("memory"), f"byte {begin}", "the file ends before its frames do")
            at += size
        return decode(out, self.character)


def encode(qpos: np.ndarray, dtype: Dtype) -> np.ndarray:
    """Stored rows of poses (T, nq): float32, or float16 with three more columns for what the root's halves lost."""
    if dtype == "float32":
        return qpos.astype(np.float32)
    if dtype != "float16":
        raise ValueError(f"dtype is {dtype!r}; a library stores float32 or float16")
    if np.abs(qpos).max() > LIMIT16:
        raise ValueError(f"a value of {np.abs(qpos).max():.3g} is too large for float16; write float32")
    half = qpos.astype(np.float16)
    return np.concatenate([half, (qpos[:, :3] - half[:, :3]).astype(np.float16)], axis=1)


def decode(rows: np.ndarray, character: str) -> np.ndarray:
    """Poses (T, nq) float32 of stored rows; quaternions that came from halves are made unit."""
    if rows.dtype == np.float32:
        return rows
    qpos = rows[:, :-3].astype(np.float32)
    qpos[:, :3] += rows[:, -3:]
    for column in quaternion_columns(Character.load(character)):
        q = qpos[:, column : column + 4]
        q /= np.sqrt(np.einsum("ij,ij->i", q, q))[:, None]
    return qpos


def write_part(
    path: Path, clips: Iterable[Clip], dtype: Dtype, *, before: Part | None = None, character: str | None = None
) -> None:
    """Write clips as one file at path: room for the header, the frames as they come, the index, then the header.

    before: a part whose clips come first, copied as they are; character: the one these clips must be of.
    """
    names, sources, lengths, fps, loop = [], [], [], [], []
    character = before.character if before else character
    with path.open("wb") as file:
        file.write(bytes(HEADER))
        if before:
            names, sources = list(before.names), list(before.sources)
            lengths, fps, loop = before.lengths.tolist(), before.fps.tolist(), before.loop.tolist()
            for begin, size in zip(before.starts.tolist(), before.lengths.tolist(), strict=True):
                file.write(before.frames[begin : begin + size].tobytes())
        for clip in clips:
            character = character or clip.character
            one_character([character, clip.character])
            file.write(encode(clip.qpos, dtype).tobytes())
            names.append(clip.name)
            sources.append(clip.source)
            lengths.append(len(clip.qpos))
            fps.append(clip.fps)
            loop.append(clip.loop)
        if not lengths or character is None:
            raise ValueError("a library needs at least one clip")
        count, total, nq = len(lengths), sum(lengths), Character.load(character).nq
        shape = {"qpos": ("F32", [total, nq])} if dtype == "float32" else {"qpos16": ("F16", [total, nq + 3])}
        index = {"starts": np.cumsum(lengths) - np.array(lengths), "lengths": lengths, "fps": fps, "loop": loop}
        texts = {"names": text_bytes(names), "sources": text_bytes(sources)}
        texts["sources"] += b" " * (-(file.tell() + sum(map(len, texts.values()))) % 8)  # aligns what follows
        columns = {name: np.asarray(index[name], dtype=CODES[code]).tobytes() for name, code in INDEX.items()}
        entries = [(name, *what, file.tell() - HEADER) for name, what in shape.items()]
        entries += [(name, "U8", [len(text)], len(text)) for name, text in texts.items()]
        entries += [(name, INDEX[name], [count], len(column)) for name, column in columns.items()]
        header: dict[str, dict] = {"__metadata__": {"kind": "clips", "character": character}}
        at = 0
        for name, code, sizes, length in entries:
            header[name] = {"dtype": code, "shape": sizes, "data_offsets": [at, at + length]}
            at += length
        for blob in (*texts.values(), *columns.values()):
            file.write(blob)
        text = json.dumps(header).encode()
        if len(text) > HEADER - 8:
            raise ValueError(f"the character's name has {len(character)} letters; a library's header keeps {HEADER}")
        file.seek(0)
        file.write((HEADER - 8).to_bytes(8, "little") + text.ljust(HEADER - 8))
        file.flush()
        os.fsync(file.fileno())


def open_part(path: Path) -> Part:
    """One file as a part: the index mapped, the frames left where they are, everything checked but the frames."""
    file = path.open("rb")
    header, base = _header(path, file)
    metadata = header.pop("__metadata__", None)
    if not isinstance(metadata, dict) or metadata.get("kind") != "clips":
        raise FormatError(path, "metadata", "not a clip library; make one with `kinetok clips import`")
    if not isinstance(metadata.get("character"), str):
        raise FormatError(path, "metadata", "names no character")
    name = "qpos16" if "qpos16" in header else "qpos"
    data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    wanted = {name: "F16" if name == "qpos16" else "F32"} | INDEX
    wanted |= {key: "U8" for key in ("names", "sources") if key in header}
    views = {key: _view(path, key, header, code, data, base) for key, code in wanted.items()}
    texts = [views[k] if k in views else str(metadata.get(k, "")).encode() for k in ("names", "sources")]
    part = Part(
        character=metadata["character"],
        **{key: views[key] for key in INDEX},
        frames=views[name],
        texts=(texts[0], texts[1]),
        path=path,
        file=file,
        map=data,
        offset=base + header[name]["data_offsets"][0],
    )
    _check_index(path, part)
    part.forget()
    return part


def _header(path: Path, file: BinaryIO) -> tuple[dict, int]:
    """The header of a safetensors file and where its data begins: 8 bytes of size, JSON, data."""
    total = os.fstat(file.fileno()).st_size
    size = int.from_bytes(file.read(8), "little")
    if not 2 <= size <= min(total - 8, LONGEST_HEADER):
        raise FormatError(path, "header", f"not a readable safetensors file: a header of {size} bytes in {total}")
    try:
        header = json.loads(file.read(size))
    except (ValueError, RecursionError) as error:
        raise FormatError(path, "header", f"not a readable safetensors file: {error}") from None
    if not isinstance(header, dict):
        raise FormatError(path, "header", f"not a readable safetensors file: {type(header).__name__}, not an object")
    return header, 8 + size


def _view(path: Path, key: str, header: dict, code: str, data: mmap.mmap, base: int) -> np.ndarray:
    """A read-only view of one tensor's bytes in the file."""
    if key not in header:
        raise FormatError(path, key, "missing; a clip library has qpos or qpos16, starts, lengths, fps and loop")
    entry, axes = header[key], 2 if key.startswith("qpos") else 1
    entry = entry if isinstance(entry, dict) else {}
    shape, offsets = _sizes(entry.get("shape")), _sizes(entry.get("data_offsets"))
    if entry.get("dtype") != code or len(shape) != axes or len(offsets) != 2:
        raise FormatError(
            path, key, f"{entry.get('dtype')} of shape {shape}; a library holds {code}, {axes} axes, there"
        )
    count = shape[0] * (shape[1] if axes == 2 else 1)
    begin, end = offsets
    if end - begin != count * np.dtype(CODES[code]).itemsize or base + end > len(data):
        raise FormatError(path, key, f"shape {shape} in bytes {begin} to {end}; the file holds {len(data) - base}")
    return np.frombuffer(data, CODES[code], count=count, offset=base + begin).reshape(shape)


def _sizes(value: object) -> list[int]:
    good = isinstance(value, list) and all(type(n) is int and 0 <= n < 2**62 for n in value)
    return value if isinstance(value, list) and good else []


def _check_index(path: Path, part: Part) -> None:
    """The clips lie one behind the other within the frames, with two of them at least and a positive rate."""
    try:
        columns = Character.load(part.character).nq + 3 * (part.frames.dtype == np.float16)
    except (ValueError, OSError) as error:
        raise FormatError(path, "character", str(error)) from None
    if part.frames.shape[1] != columns:
        raise FormatError(path, "qpos", f"{part.frames.shape[1]} columns; {part.character!r} needs {columns}")
    count = {len(part.starts), len(part.lengths), len(part.fps), len(part.loop)}
    if len(count) > 1 or 0 in count:
        raise FormatError(path, "starts", f"the index has {sorted(count)} rows; every column needs one per clip")
    total, ends = len(part.frames), np.cumsum(part.lengths)
    wrong = (part.lengths < 2) | (part.lengths > total) | (part.starts != ends - part.lengths) | (ends > total)
    if wrong.any():
        clip = int(np.argmax(wrong))
        where = f"starts at frame {part.starts[clip]}, has {part.lengths[clip]}"
        raise FormatError(path, f"clip {clip}", f"{where}; two at least, one clip behind the other, {total} in all")
    if not (np.isfinite(part.fps) & (part.fps > 0)).all():
        clip = int(np.argmin(np.isfinite(part.fps) & (part.fps > 0)))
        raise FormatError(path, f"clip {clip}", f"fps is {part.fps[clip]}; it must be positive")


def one_character(characters: Sequence[str]) -> None:
    """Refuse clips of more than one character."""
    names = sorted(set(characters))
    if len(names) > 1:
        raise ValueError(f"one library holds one character; these clips are of {', '.join(names)}")


def text_bytes(texts: Sequence[str]) -> bytes:
    """Names or sources as they stand in a part."""
    return json.dumps(list(texts), ensure_ascii=False).encode()
