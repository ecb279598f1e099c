"""Many clips in one file, or in a folder of such files, of any size: a few hours or a thousand.

    ClipLibrary.write(Path("walks.safetensors"), clips, dtype="float16")   # streams: clips may be a generator
    ClipLibrary.append(Path("walks"), clips)                               # a folder: one more part, atomically
    library = ClipLibrary.open(Path("walks.safetensors"), mirror=True)     # reads the header, not the frames
    train, held_out = library.split(held_out=0.1)                          # by source: excerpts never straddle
    ids = library.sample(4096, None, rng)
    qpos = library.at(ids, times)                                          # (K, nq), interpolated, loops continue

A part is a safetensors file: the frames, one row per clip of start, length, fps and loop, and the names and
sources as JSON bytes. Frames are float32 (`qpos`), or float16 (`qpos16`: qpos and three columns with what the
halves of the root position left over, so that the root is exact to 0.02 mm within 200 m). `at` reads the rows it
needs and no others, so memory does not grow with the library. Refused: clips of different
characters, files that are not libraries or whose index does not fit their frames.
"""

import functools
import hashlib
import itertools
import os
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from kinetok.motion.character import Character
from kinetok.motion.clip import MIRRORED, Clip, interpolate, quaternion_columns
from kinetok.motion.error import FormatError
from kinetok.motion.part import Dtype, Part, one_character, open_part, text_bytes, write_part
from kinetok.rotation import normalize

POSES = 1 << 14  # poses worked on at a time: their intermediate results stay in the cache


@dataclass(frozen=True, kw_only=True, eq=False)
class ClipLibrary:
    """parts: where the clips lie; chosen: (K,) indices into all clips of the parts, None for all of them in order;
    mirror: every clip is there twice, the second half of the indices is the mirror image of the first."""

    parts: tuple[Part, ...] = field(repr=False)
    chosen: np.ndarray | None = field(default=None, repr=False)
    mirror: bool = False

    @staticmethod
    def of(clips: Sequence[Clip]) -> "ClipLibrary":
        """A library in memory."""
        if not clips:
            raise ValueError("a library needs at least one clip")
        one_character([clip.character for clip in clips])
        lengths = np.array([len(clip.qpos) for clip in clips], dtype=np.int64)
        part = Part(
            character=clips[0].character,
            starts=np.cumsum(lengths) - lengths,
            lengths=lengths,
            fps=np.array([clip.fps for clip in clips]),
            loop=np.array([clip.loop for clip in clips]),
            frames=np.concatenate([clip.qpos for clip in clips]).astype(np.float32),
            texts=(text_bytes([clip.name for clip in clips]), text_bytes([clip.source for clip in clips])),
        )
        return ClipLibrary(parts=(part,))

    @staticmethod
    def write(path: Path | str, clips: Iterable[Clip], *, dtype: Dtype = "float32") -> None:
        """Write the clips as one file, one after the other; the file appears whole or not at all."""
        path = Path(path)
        clips = _begun(clips)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = _temporary(path)
        try:
            write_part(temporary, clips, dtype)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    @staticmethod
    def append(path: Path | str, clips: Iterable[Clip], *, dtype: Dtype | None = None) -> None:
        """Add clips to a library; without dtype they are stored as the last part is.

        A folder gains one part, whatever its size, also from several writers at once. A single file (.safetensors) is
        written anew with the clips behind and then replaced: time and disk in proportion to it, one writer at a time.
        Both happen whole or not at all.
        """
        path = Path(path)
        clips = _begun(clips)
        old = ClipLibrary.open(path) if path.exists() and (path.is_file() or _part_paths(path)) else None
        wanted: Dtype = dtype or (_dtype(old.parts[-1]) if old else "float32")
        if path.suffix == ".safetensors":
            if old and _dtype(old.parts[0]) != wanted:
                raise ValueError(f"{path} holds {_dtype(old.parts[0])}; one file holds one dtype, a folder can mix")
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = _temporary(path)
            try:
                write_part(temporary, clips, wanted, before=old.parts[0] if old else None)
                os.replace(temporary, path)
            finally:
                temporary.unlink(missing_ok=True)
            return
        path.mkdir(parents=True, exist_ok=True)
        temporary = _temporary(path / "part.safetensors")
        try:
            write_part(temporary, clips, wanted, character=old.character if old else None)
            for number in itertools.count(len(old.parts) if old else 0):
                try:
                    os.link(temporary, path / f"part-{number:05d}.safetensors")  # fails where another writer was faster
                    return
                except FileExistsError:
                    continue
        finally:
            temporary.unlink(missing_ok=True)

    @staticmethod
    def open(path: Path | str, *, mirror: bool = False) -> "ClipLibrary":
        """Read the index of a file, or of all parts in a folder; frames are read from disk when they are sampled."""
        path = Path(path)
        paths = _part_paths(path) if path.is_dir() else [path]
        if not paths:
            raise FormatError(path, "folder", "holds no part of a clip library (*.safetensors)")
        parts = tuple(open_part(part) for part in paths)
        for part, place in zip(parts, paths, strict=True):
            if part.character != parts[0].character:
                other = f"{part.character!r}, the first part of {parts[0].character!r}"
                raise FormatError(place, "character", f"clips of {other}; one library holds one character")
        return ClipLibrary(parts=parts, mirror=mirror)

    def __len__(self) -> int:
        return self._count * (1 + self.mirror)

    @functools.cached_property
    def _count(self) -> int:
        return sum(len(part) for part in self.parts) if self.chosen is None else len(self.chosen)

    @functools.cached_property
    def _firsts(self) -> np.ndarray:
        """Index of the first clip (P + 1,) of each part."""
        return np.cumsum([0, *(len(part) for part in self.parts)])

    @property
    def character(self) -> str:
        return self.parts[0].character

    @property
    def names(self) -> tuple[str, ...]:
        """One per clip; that of a mirror image ends in -mirrored."""
        names = self._texts("names")
        return names + tuple(name + MIRRORED for name in names) if self.mirror else names

    @property
    def sources(self) -> tuple[str, ...]:
        """Where each clip came from; a mirror image has the source of its clip."""
        return self._texts("sources") * (1 + self.mirror)

    def _texts(self, which: Literal["names", "sources"]) -> tuple[str, ...]:
        all_of: tuple[str, ...] = tuple(text for part in self.parts for text in getattr(part, which))
        return all_of if self.chosen is None else tuple(all_of[i] for i in self.chosen)

    @property
    def lengths(self) -> np.ndarray:
        """Frames (K,) of each clip."""
        return self._column("lengths")

    @property
    def fps(self) -> np.ndarray:
        """Frames per second (K,) of each clip."""
        return self._column("fps")

    @property
    def loop(self) -> np.ndarray:
        """Whether each clip (K,) repeats."""
        return self._column("loop").astype(bool)

    @property
    def seconds(self) -> np.ndarray:
        """Duration (K,) of each clip; of one cycle for loops."""
        return (self.lengths - 1) / self.fps

    def _column(self, name: str) -> np.ndarray:
        column = np.concatenate([getattr(part, name) for part in self.parts])
        column = column if self.chosen is None else column[self.chosen]
        return np.tile(column, 1 + self.mirror)

    @property
    def frames(self) -> np.ndarray:
        """All frames (F, nq) float32 of a library in memory or in one float32 file, there as a map of the file."""
        frames = self.parts[0].frames
        if len(self.parts) > 1 or frames.dtype != np.float32 or self.chosen is not None or self.mirror:
            raise ValueError("frames are one array only in all of one float32 file; use clip() or at()")
        return frames

    def identity(self) -> dict[str, Any]:
        """Which clips these are, so that a run goes on with no others: their names, and a sha256 of what they hold."""
        digest = hashlib.sha256()
        for index in range(len(self)):
            clip = self.clip(index)
            digest.update(f"{clip.character} {clip.fps} {clip.loop} {clip.qpos.shape}".encode())
            digest.update(np.ascontiguousarray(clip.qpos, dtype="<f4").data)
        return {"clips": list(self.names), "frames": digest.hexdigest()}

    def _place(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Part, index in it and whether it is mirrored, for clips ids (N,)."""
        if len(ids) and (ids.min() < 0 or ids.max() >= len(self)):
            raise IndexError(f"clips {ids.min()} to {ids.max()} of a library of {len(self)}")
        turned, inner = ids >= self._count, ids % self._count
        inner = inner if self.chosen is None else self.chosen[inner]
        part = np.searchsorted(self._firsts, inner, side="right") - 1
        return part, inner - self._firsts[part], turned

    def clip(self, index: int) -> Clip:
        """One clip, copied out, its quaternions made unit again in float64."""
        (number,), (inner,), (turned,) = self._place(np.array([index % len(self) if index < 0 else index]))
        part = self.parts[number]
        qpos = part.rows(part.starts[[inner]], part.lengths[[inner]]).astype(np.float64)
        try:
            columns = quaternion_columns(Character.load(self.character))[:, None] + np.arange(4)
            qpos[:, columns] = normalize(qpos[:, columns])
            clip = Clip(
                name=part.names[inner],
                character=self.character,
                fps=float(part.fps[inner]),
                qpos=qpos,
                loop=bool(part.loop[inner]),
                source=part.sources[inner],
            )
        except ValueError as error:
            if part.path is None:
                raise
            raise FormatError(part.path, f"clip {inner}", str(error)) from None
        return clip.mirror() if turned else clip

    def subset(self, ids: np.ndarray) -> "ClipLibrary":
        """A library of these clips alone; frames stay where they are."""
        if self.mirror:
            raise ValueError("take the subset first and mirror it afterwards: subset(ids).mirrored()")
        ids = np.asarray(ids)
        if not len(ids):
            raise ValueError("a library needs at least one clip")
        self._place(ids)
        return replace(self, chosen=ids if self.chosen is None else self.chosen[ids])

    def mirrored(self) -> "ClipLibrary":
        """The same clips and their mirror images, which are made when they are read."""
        return replace(self, mirror=True)

    def split(self, held_out: float = 0.1, seed: int = 0) -> tuple["ClipLibrary", "ClipLibrary"]:
        """Two libraries, for training and held out; all clips of one source lie on one side.

        The hash of a source (of a clip's name where it has none) decides, so a clip stays on its side when others are
        added; the share of clips is held_out on average over many sources.
        """
        if not 0 < held_out < 1:
            raise ValueError(f"held_out is {held_out}; it is a share between 0 and 1")
        plain = replace(self, mirror=False)
        sources = [source or name for source, name in zip(plain.sources, plain.names, strict=True)]
        share = {source: _share(seed, source) for source in set(sources)}
        out = np.array([share[source] < held_out for source in sources])
        if out.all() or not out.any():
            side = "training" if out.all() else "the held-out side"
            raise ValueError(f"no source of {len(share)} falls to {side}; try another seed or share (held_out, seed)")
        train, held = plain.subset(np.flatnonzero(~out)), plain.subset(np.flatnonzero(out))
        return replace(train, mirror=self.mirror), replace(held, mirror=self.mirror)

    def sample(self, count: int, weights: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
        """Clip indices (count,) drawn in proportion to weights (K,) >= 0; without weights, to the frames of each.

        With weights the time grows with the number of clips; without, by its logarithm.
        """
        if weights is None:
            drawn = self._draw(rng.integers(0, self._edges[-1], count))
            return drawn + self._count * rng.integers(0, 2, count) if self.mirror else drawn
        if len(weights) != len(self):
            raise ValueError(f"{len(weights)} weights for a library of {len(self)} clips")
        edges = np.cumsum(weights, dtype=np.float64)
        return np.searchsorted(edges, rng.random(count) * edges[-1], side="right").clip(max=len(self) - 1)

    @functools.cached_property
    def _edges(self) -> np.ndarray:
        """Frames up to the end of each part (P,), or of each clip (K,) where only some are chosen."""
        if self.chosen is None:
            return np.cumsum([len(part.frames) for part in self.parts])
        return np.cumsum(replace(self, mirror=False).lengths)

    def _draw(self, frames: np.ndarray) -> np.ndarray:
        """Clips (N,) that hold these frames (N,), counted over all clips."""
        number = np.searchsorted(self._edges, frames, side="right")
        if self.chosen is not None:
            return number
        before = np.concatenate([[0], self._edges[:-1]])
        for index in np.unique(number):
            here = number == index
            frames[here] = self._firsts[index] + self.parts[index].drawn(frames[here] - before[index])
        return frames

    def at(self, ids: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Poses (N, nq) float32 of clips ids (N,) at times (N,) seconds, or (N, W, nq) at times (N, W); see Clip.at.

        Each row reads the frames between its earliest and its latest time in one go: sorted times read least.
        """
        times = np.asarray(times, dtype=np.float64)
        if times.shape[:1] != ids.shape or times.ndim not in (1, 2):
            raise ValueError(f"times have shape {times.shape}; {len(ids)} clips need ({len(ids)},) or ({len(ids)}, W)")
        windows = times if times.ndim == 2 else times[:, None]
        body = Character.load(self.character)
        pose = np.empty((*windows.shape, body.nq), np.float32)
        number, inner, turned = self._place(np.asarray(ids))
        for index in np.unique(number):
            here = np.flatnonzero(number == index)
            for some in np.array_split(here, max(1, len(here) * windows.shape[1] // POSES)):
                pose[some] = _windows(self.parts[index], body, inner[some], windows[some])
        if turned.any():
            pose[turned] = body.mirror_qpos(pose[turned])
        return pose if times.ndim == 2 else pose[:, 0]


def _windows(part: Part, body: Character, ids: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Poses (N, W, nq) of clips ids (N,) of one part at times (N, W)."""
    starts, lengths, fps, loop = part.entries(ids)
    last, fps = lengths[:, None] - 1, fps[:, None]
    seconds = last / fps
    cycles = np.where(loop[:, None], np.floor(times / seconds + 1e-9), 0)
    frame = np.clip((times - cycles * seconds) * fps, 0, last)
    low = np.minimum(frame.astype(np.int64), last - 1)
    share = (frame - low).astype(np.float32)
    first, span = low.min(1), np.ptp(low, axis=1) + 2
    rows = part.rows(starts + first, span)
    at = (low - first[:, None] + (np.cumsum(span) - span)[:, None]).ravel()
    pose = interpolate(body, rows[at], rows[at + 1], share.ravel()).reshape(*times.shape, body.nq)
    if loop.any():
        begin, one = starts[loop], np.ones(int(loop.sum()), np.int64)
        travel = part.rows(begin + last[loop, 0], one)[:, :2] - part.rows(begin, one)[:, :2]
        pose[loop, :, :2] += cycles[loop, :, None].astype(np.float32) * travel[:, None]
    return pose


def _share(seed: int, source: str) -> float:
    return int.from_bytes(hashlib.sha256(f"{seed}:{source}".encode()).digest()[:8], "big") / 2**64


def _begun(clips: Iterable[Clip]) -> Iterator[Clip]:
    """The clips with the first one read already: if that fails, no folder has been made."""
    clips = iter(clips)
    return itertools.chain(list(itertools.islice(clips, 1)), clips)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")


def _part_paths(path: Path) -> list[Path]:
    return sorted(p for p in path.iterdir() if p.suffix == ".safetensors" and not p.name.startswith("."))


def _dtype(part: Part) -> Dtype:
    return "float16" if part.frames.dtype == np.float16 else "float32"
