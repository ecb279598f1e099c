"""Motion files. One file per format; each reader returns a motion or raises FormatError with the file and the place.

    motions = read(Path("walk.bvh"))                  # [SkeletonMotion], as recorded, or [Clip] of its own character
    clips = read_clips(Path("recordings"), "g1")      # every file of a folder, skeletons retargeted to the character

A format is told by its suffix, and by content where a suffix is not its own. In a folder, files of no known format are
passed over; a file that is named must be readable. Clips keep the character they were recorded for: DeepMimic's
humanoid, Unitree's G1.
"""

import fnmatch
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from kinetok.motion.check import mend
from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.formats.amass import is_amass, read_amass, write_amass
from kinetok.motion.formats.asf_amc import read_amc
from kinetok.motion.formats.bvh import read_bvh, write_bvh
from kinetok.motion.formats.deepmimic import is_deepmimic, read_deepmimic
from kinetok.motion.formats.gmr import is_gmr, read_gmr
from kinetok.motion.formats.mimickit import is_mimickit, read_mimickit
from kinetok.motion.formats.mjlab import is_mjlab, read_mjlab
from kinetok.motion.formats.poselib import is_poselib, read_poselib
from kinetok.motion.formats.protomotions import read_protomotions
from kinetok.motion.formats.robot_csv import is_robot_csv, read_robot_csv, write_robot_csv
from kinetok.motion.library import ClipLibrary
from kinetok.motion.retarget import retarget
from kinetok.motion.rigs import RigError
from kinetok.motion.skeleton import SkeletonMotion


def by_suffix(path: Path) -> bool:
    """True: the suffix is this format's alone, so whatever is wrong inside is an error and not another format."""
    return path.is_file()


def read_library(path: Path) -> list[Clip]:
    """All clips of a kinetok library."""
    library = ClipLibrary.open(path)
    return [library.clip(index) for index in range(len(library))]


@dataclass(frozen=True)
class Format:
    """name; suffixes: lower case; sniff: whether a file of such a suffix is one; read: its reader; rate: the reader
    takes `fps`, since the files name no frame rate."""

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[Path], bool]
    read: Callable[..., Clip | SkeletonMotion | list[Clip]]
    rate: bool = False


FORMATS = (
    Format("DeepMimic", (".txt", ".json"), is_deepmimic, read_deepmimic),
    Format("kinetok", (".safetensors",), by_suffix, read_library),
    Format("BVH", (".bvh",), by_suffix, read_bvh),
    Format("ASF/AMC", (".amc",), by_suffix, read_amc, rate=True),
    Format("AMASS", (".npz",), is_amass, read_amass),
    Format("mjlab", (".npz",), is_mjlab, read_mjlab),
    Format("Unitree G1", (".csv",), is_robot_csv, read_robot_csv, rate=True),
    Format("GMR", (".pkl",), is_gmr, read_gmr),
    Format("MimicKit", (".pkl",), is_mimickit, read_mimickit),
    Format("ProtoMotions", (".motion",), by_suffix, read_protomotions),
    Format("poselib (AMP)", (".npy",), is_poselib, read_poselib),
)
# Names that come with motion and are none, first match wins.
NO_MOTION = (
    ("shape.npz", "the body shape of an AMASS subject; the motions lie beside it"),
    ("*stagei.npz", "AMASS's fit of a body shape (stage i); the motion is in the *_stageii.npz"),
    ("*.asf", "the skeleton that .amc files refer to; read those"),
    ("*.xml", "a character, not a motion; give it as the character"),
    ("license*", "a licence text"),
    ("*.md", "a text"),
)


def read(path: Path, *, fps: float | None = None) -> list[Clip | SkeletonMotion]:
    """The motions of a file, of a kinetok library, or of every such file directly in a folder.

    fps: the frame rate of files that name none (robot CSV, AMC); None is their format's usual one, see `source`.
    """
    return [motion for file, known in _files(path) for motion in _read(file, known, fps)]


def read_clips(path: Path, character: str | None = None, *, fps: float | None = None) -> list[Clip]:
    """The motions of a path as clips. Recorded skeletons are mended (motion.check) and retargeted to `character`,
    "humanoid" when None; clips of a robot or of a library stay what they are, and one of another character than asked
    for is refused."""
    motions = [(file, motion) for file, known in _files(path) for motion in _read(file, known, fps)]
    return [_fit(file, motion, character) for file, motion in motions]


def _fit(path: Path, motion: Clip | SkeletonMotion, character: str | None) -> Clip:
    if isinstance(motion, SkeletonMotion):
        try:
            return retarget(mend(motion)[0], character or "humanoid").clip
        except RigError as error:
            raise FormatError(path, "skeleton", str(error)) from None
    if character not in (None, motion.character):
        reason = f"is a motion of {motion.character!r}; only recorded skeletons are retargeted to {character!r}"
        raise FormatError(path, motion.name, reason)
    return motion


def _files(path: Path) -> list[tuple[Path, Format]]:
    """The motion files at a path and their formats."""
    if path.is_dir():
        named = [(file, _format(file)) for file in sorted(path.iterdir()) if file.is_file()]
        files = [(file, known) for file, known in named if known]
        if not files:
            raise FormatError(path, "folder", f"holds no motion file; {_listing()}")
        return files
    if not path.exists():
        raise FormatError(path, "file", "does not exist")
    if _no_motion(path):
        raise FormatError(path, "file", f"is no motion: it is {_no_motion(path)}")
    if not path.stat().st_size:
        raise FormatError(path, "file", "is empty")
    fitting = [known for known in FORMATS if path.suffix.lower() in known.suffixes]
    found = _format(path) or (fitting[0] if len(fitting) == 1 and fitting[0] is not FORMATS[0] else None)
    if found is None:
        raise FormatError(path, "first bytes", f"unknown format; {_listing()}")
    return [(path, found)]


def _read(path: Path, known: Format, fps: float | None) -> list[Clip | SkeletonMotion]:
    motion = known.read(path, fps=fps) if known.rate else known.read(path)
    return list(motion) if isinstance(motion, list) else [motion]


def _format(path: Path) -> Format | None:
    """The format of a file, or None."""
    if _no_motion(path):
        return None
    return next((known for known in FORMATS if path.suffix.lower() in known.suffixes and known.sniff(path)), None)


def _no_motion(path: Path) -> str:
    name = path.name.lower()
    return next((reason for pattern, reason in NO_MOTION if fnmatch.fnmatchcase(name, pattern)), "")


def _listing() -> str:
    return "formats: " + ", ".join(f"{known.name} {'/'.join(known.suffixes)}" for known in FORMATS)


__all__ = [
    "FORMATS",
    "Clip",
    "ClipLibrary",
    "FormatError",
    "SkeletonMotion",
    "read",
    "read_amass",
    "read_amc",
    "read_bvh",
    "read_clips",
    "read_deepmimic",
    "read_gmr",
    "read_mimickit",
    "read_mjlab",
    "read_poselib",
    "read_protomotions",
    "read_robot_csv",
    "write_amass",
    "write_bvh",
    "write_robot_csv",
]
