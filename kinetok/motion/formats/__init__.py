"""One file per format; every reader returns a Clip or raises FormatError naming the file and the place."""

from pathlib import Path

from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.formats.deepmimic import is_deepmimic, read_deepmimic
from kinetok.motion.library import ClipLibrary


def read_clips(path: Path) -> list[Clip]:
    """All clips of a motion file, of a kinetok library, or of every such file in a folder, by content."""
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.is_file() and (p.suffix == ".safetensors" or is_deepmimic(p)))
        if not files:
            raise FormatError(path, "folder", "holds no motion file; formats: DeepMimic .txt, kinetok .safetensors")
        return [clip for file in files for clip in read_clips(file)]
    if not path.exists():
        raise FormatError(path, "file", "does not exist")
    if path.suffix == ".safetensors":
        library = ClipLibrary.open(path)
        return [library.clip(index) for index in range(len(library))]
    if is_deepmimic(path):
        return [read_deepmimic(path)]
    raise FormatError(path, "first bytes", "unknown format; formats: DeepMimic .txt, kinetok .safetensors")


__all__ = ["Clip", "ClipLibrary", "FormatError", "read_clips", "read_deepmimic"]
