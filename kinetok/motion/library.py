"""Many clips in one memory-mapped file.

    ClipLibrary.write(Path("walks.safetensors"), clips)
    library = ClipLibrary.open(Path("walks.safetensors"))      # reads the index, not the frames
    ids = library.sample(4096, weights, rng)
    qpos = library.at(ids, times)                              # (K, nq), interpolated, loops continue

A library is a safetensors file: qpos (frames, nq) float32 and one row per clip of start, length, fps and loop;
names, sources and the character are in its metadata. Refused: clips of different characters, files that are
not libraries.
"""

import json
import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from kinetok.motion.character import Character
from kinetok.motion.clip import Clip, interpolate, quaternion_columns
from kinetok.motion.error import FormatError
from kinetok.rotation import normalize


@dataclass(frozen=True, kw_only=True, eq=False)
class ClipLibrary:
    """character; names, sources (K,); starts, lengths (K,) frames; fps (K,); loop (K,) bool; frames (F, nq)."""

    character: str
    names: tuple[str, ...]
    sources: tuple[str, ...]
    starts: np.ndarray = field(repr=False)
    lengths: np.ndarray = field(repr=False)
    fps: np.ndarray = field(repr=False)
    loop: np.ndarray = field(repr=False)
    frames: np.ndarray = field(repr=False)

    @staticmethod
    def of(clips: Sequence[Clip]) -> "ClipLibrary":
        """A library in memory."""
        if not clips:
            raise ValueError("a library needs at least one clip")
        characters = sorted({clip.character for clip in clips})
        if len(characters) > 1:
            raise ValueError(f"one library holds one character; these clips are of {', '.join(characters)}")
        lengths = np.array([len(clip.qpos) for clip in clips], dtype=np.int64)
        return ClipLibrary(
            character=characters[0],
            names=tuple(clip.name for clip in clips),
            sources=tuple(clip.source for clip in clips),
            starts=np.cumsum(lengths) - lengths,
            lengths=lengths,
            fps=np.array([clip.fps for clip in clips]),
            loop=np.array([clip.loop for clip in clips]),
            frames=np.concatenate([clip.qpos for clip in clips]).astype(np.float32),
        )

    @staticmethod
    def write(path: Path, clips: Sequence[Clip]) -> None:
        """Write the clips as one file; the file appears whole or not at all."""
        library = ClipLibrary.of(clips)
        tensors = {"qpos": library.frames, "starts": library.starts, "lengths": library.lengths, "fps": library.fps}
        tensors["loop"] = library.loop.astype(np.uint8)
        metadata = {
            "kind": "clips",
            "character": library.character,
            "names": json.dumps(library.names),
            "sources": json.dumps(library.sources),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        save_file(tensors, temporary, metadata)
        os.replace(temporary, path)

    @staticmethod
    def open(path: Path) -> "ClipLibrary":
        """Map the file; frames are read from disk when they are sampled."""
        try:
            with safe_open(path, framework="np") as file:
                metadata = file.metadata() or {}
                if metadata.get("kind") != "clips":
                    raise FormatError(path, "metadata", "not a clip library; make one with `kinetok clips import`")
                index = {key: file.get_tensor(key) for key in ("starts", "lengths", "fps", "loop")}
        except SafetensorError as error:
            raise FormatError(path, "header", f"not a readable safetensors file: {error}") from None
        return ClipLibrary(
            character=metadata["character"],
            names=tuple(json.loads(metadata["names"])),
            sources=tuple(json.loads(metadata["sources"])),
            starts=index["starts"],
            lengths=index["lengths"],
            fps=index["fps"],
            loop=index["loop"].astype(bool),
            frames=_map(path, "qpos"),
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def seconds(self) -> np.ndarray:
        """Duration (K,) of each clip; of one cycle for loops."""
        return (self.lengths - 1) / self.fps

    def clip(self, index: int) -> Clip:
        """One clip, copied out, its quaternions made unit again in float64."""
        start, stop = self.starts[index], self.starts[index] + self.lengths[index]
        qpos = np.array(self.frames[start:stop], dtype=np.float64)
        columns = quaternion_columns(Character.load(self.character))[:, None] + np.arange(4)
        qpos[:, columns] = normalize(qpos[:, columns])
        return Clip(
            name=self.names[index],
            character=self.character,
            fps=float(self.fps[index]),
            qpos=qpos,
            loop=bool(self.loop[index]),
            source=self.sources[index],
        )

    def sample(self, count: int, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Clip indices (count,) drawn in proportion to weights (K,) >= 0."""
        edges = np.cumsum(weights, dtype=np.float64)
        return np.searchsorted(edges, rng.random(count) * edges[-1], side="right").clip(max=len(self) - 1)

    def at(self, ids: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Poses (N, nq) float32 of clips ids (N,) at times (N,) seconds; see Clip.at."""
        seconds, last = self.seconds[ids], self.lengths[ids] - 1
        cycles = np.where(self.loop[ids], np.floor(times / seconds + 1e-9), 0)
        frame = np.clip((times - cycles * seconds) * self.fps[ids], 0, last)
        low = np.minimum(frame.astype(np.int64), last - 1)
        first = self.starts[ids]
        share = (frame - low).astype(np.float32)
        body = Character.load(self.character)
        pose = interpolate(body, self.frames[first + low], self.frames[first + low + 1], share)
        travel = self.frames[first + last, :2] - self.frames[first, :2]
        pose[:, :2] += cycles[:, None].astype(np.float32) * travel
        return pose


def _map(path: Path, name: str) -> np.ndarray:
    """A read-only view of one tensor's bytes in the file (layout: 8-byte size, JSON header, data)."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
        entry = json.loads(file.read(size))[name]
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    begin, _ = entry["data_offsets"]
    count = int(np.prod(entry["shape"]))
    return np.frombuffer(data, np.float32, count=count, offset=8 + size + begin).reshape(entry["shape"])
