"""Motion files. One file per format; each reader returns a motion or raises FormatError with the file and the place.

    motions = read(Path("walk.bvh"))                  # [SkeletonMotion], as recorded, or [Clip] of its own character
    clips = read_clips(Path("recordings"), "g1")      # every file of a folder, skeletons retargeted to the character
    for clip in each_clip(Path("large"), "g1"): ...   # the same one after the other, none of them kept

A format is told by its suffix, and by content where a suffix is not its own. In a folder and the folders in it, files
of no known format are passed over; a file that is named must be readable. Clips keep the character they were recorded
for: DeepMimic's humanoid, Unitree's G1.
"""

import fnmatch
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.motion.check import FLOOR_WRONG, mend, report
from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.export import skeleton_motion
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
from kinetok.motion.retarget import Retargeted, retarget
from kinetok.motion.rigs import RigError, known_family
from kinetok.motion.skeleton import SkeletonMotion


def by_suffix(path: Path) -> bool:
    """True: the suffix is this format's alone, so whatever is wrong inside is an error and not another format."""
    return path.is_file()


def read_library(path: Path) -> Iterator[Clip]:
    """The clips of a kinetok library, one after the other."""
    library = ClipLibrary.open(path)
    return (library.clip(index) for index in range(len(library)))


class Told(TypedDict, total=False):
    """What a file may not say, and the caller can. fps: of files that name no rate (robot CSV, AMC); dialect: of robot
    CSV that leaves it open (`robot_csv.DIALECTS`); unit, up: of BVH ("cm", "in", ...; "y" or "z"). None and what a
    format does not leave open change nothing; what is assumed instead, `source` and `unit` of the motion say."""

    fps: float | None
    dialect: str | None
    unit: str | None
    up: str | None


@dataclass(frozen=True)
class Format:
    """name; suffixes: lower case; sniff: whether a file of such a suffix is one; read: its reader; untold: what the
    files do not say and the reader takes, keys of Told."""

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[Path], bool]
    read: Callable[..., Clip | SkeletonMotion | Iterable[Clip]]
    untold: tuple[str, ...] = ()


RATES = (1.0, 1000.0)  # frames per second that a recording may have
OWN = "kinetok"
SAID = ("assumed", "guessed", "made unit")  # of what a reader did that is worth a line
FORMATS = (
    Format("DeepMimic", (".txt", ".json"), is_deepmimic, read_deepmimic),
    Format(OWN, (".safetensors",), by_suffix, read_library),
    Format("BVH", (".bvh",), by_suffix, read_bvh, untold=("unit", "up")),
    Format("ASF/AMC", (".amc",), by_suffix, read_amc, untold=("fps",)),
    Format("AMASS", (".npz",), is_amass, read_amass),
    Format("mjlab", (".npz",), is_mjlab, read_mjlab),
    Format("Unitree G1", (".csv",), is_robot_csv, read_robot_csv, untold=("fps", "dialect")),
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


def read(path: Path | str, **told: Unpack[Told]) -> list[Clip | SkeletonMotion]:
    """The motions of a file, of a kinetok library, or of every such file in a folder and those in it."""
    return [motion for file, known in files_of(path) for motion in read_file(file, known, **told)]


def read_clips(
    path: Path | str,
    character: str | None = None,
    *,
    say: Callable[[str], None] = lambda line: None,
    **told: Unpack[Told],
) -> list[Clip]:
    """The motions of a path as clips; see `each_clip`."""
    return list(each_clip(path, character, say=say, **told))


def each_clip(
    path: Path | str,
    character: str | None = None,
    *,
    parts: dict[str, str] | None = None,
    say: Callable[[str], None] = lambda line: None,
    skip: Callable[[FormatError], None] | None = None,
    **told: Unpack[Told],
) -> Iterator[Clip]:
    """The motions of a path as clips that passed the gate (motion.check), one after the other.

    What has one right repair is repaired. A wrong unit, a wrong axis, feet deep under the floor and a root that leaps
    are refused, with FormatError; a joint that leaps can be followed half-way and stays in. Recorded skeletons are then
    retargeted to `character`, "humanoid" when None, and so are clips of another body, if one is asked for. `say` hears
    of all this, a line each: what was repaired, what stays in, how well a motion was retargeted. The clips of a library
    have been through the gate when it was written. With `skip`, which hears why, what is refused is left out. parts:
    part of the body -> joint, for rigs whose joints no table knows; see motion/rigs.py.
    """
    path = Path(path)
    for file, known in files_of(path):
        try:
            for motion in each_motion(file, known, **told):
                if known.name != OWN:
                    motion = _gated(file, motion, say)
                yield _fit(file, motion, character, parts, say)
        except FormatError as error:
            if skip is None:
                raise
            skip(error)


def open_library(path: Path | str) -> ClipLibrary | None:
    """The kinetok library at a path, a file or a folder of nothing else, unread; None where something else is there."""
    path = Path(path)
    if path.is_dir():
        own = all(known.name == OWN and file.parent == path for file, known in files_of(path))
    else:
        own = path.suffix == ".safetensors" and path.is_file()
    return ClipLibrary.open(path) if own else None


def draw_clips(paths: Sequence[Path | str], hours: float, seed: int, **settings: Any) -> list[Clip]:
    """Clips drawn from everything at the paths until there are so many hours of them; settings: of `each_clip`.

    Of kinetok libraries nothing else is read, so they may be larger than memory.
    """
    pools = [open_library(path) or ClipLibrary.of(read_clips(path, **settings)) for path in paths]
    seconds = np.concatenate([pool.seconds for pool in pools])
    order = np.random.default_rng(seed).permutation(len(seconds))
    enough = int(np.searchsorted(np.cumsum(seconds[order]), 3600 * hours)) + 1
    firsts = np.cumsum([0, *(len(pool) for pool in pools)])
    drawn = np.sort(order[:enough])
    owners = np.searchsorted(firsts, drawn, side="right") - 1
    return [pools[owner].clip(int(index - firsts[owner])) for owner, index in zip(owners, drawn, strict=True)]


def _gated(path: Path, motion: Clip | SkeletonMotion, say: Callable[[str], None]) -> Clip | SkeletonMotion:
    mended, findings = mend(motion)
    for finding in findings:
        hopeless = finding.kind in ("up", "units", "floor") or finding.joint == "root position"
        if finding.severity == "refused" and hopeless:
            where = motion.name if finding.frame is None else f"{motion.name}, frame {finding.frame}"
            raise FormatError(path, where, finding.message)
    loud = [f for f in findings if f.severity != "note" or (f.kind == "floor" and abs(f.value or 0) > FLOOR_WRONG)]
    if any(word in motion.source for word in SAID):
        hint = "; `kinetok clips import --fps` takes another" if "fps assumed" in motion.source else ""
        say(f"{motion.name}: {motion.source}{hint}")
    for line in report(loud).splitlines()[:-1] if loud else ():
        # What is refused there and leaps by a joint alone is let in here.
        say(f"{motion.name}: {line.removeprefix('refused').strip()}")
    return mended


def _fit(
    path: Path,
    motion: Clip | SkeletonMotion,
    character: str | None,
    parts: dict[str, str] | None,
    say: Callable[[str], None],
) -> Clip:
    try:
        if isinstance(motion, SkeletonMotion):
            fitted = retarget(motion, character or "humanoid", parts=parts)
        elif character in (None, motion.character):
            return motion
        else:
            fitted = _on_another(motion, character)
    except ConfigError:  # of the character, not of this file
        raise
    except ValueError as error:
        raise FormatError(path, "skeleton" if isinstance(error, RigError) else motion.name, str(error)) from None
    found, mm = fitted.report, 1000
    say(
        f"{found.name}: on {fitted.clip.character} ({found.rig}), joints {mm * found.residual_mean:.0f} mm from their "
        f"targets, {mm * found.residual_max:.0f} at most; standing feet slide by {found.skate:.2f} m/s"
    )
    return fitted.clip


def _on_another(clip: Clip, character: str) -> Retargeted:
    """A clip of one body on another, by way of its skeleton; a loop becomes one cycle."""
    body = Character.load(clip.character)
    skeleton = skeleton_motion(body, clip)
    parts = {part: body.body_names[index] for part, index in body.parts.items()}
    family, _ = known_family(skeleton)  # its table says where a limb begins, roles which body turns with it
    return retarget(skeleton, character, parts=None if family else parts)


def files_of(path: Path | str) -> list[tuple[Path, Format]]:
    """The motion files at a path, in it and in its folders, and their formats."""
    path = Path(path)
    if path.is_dir():
        named = [(file, _format(file)) for file in sorted(path.rglob("*")) if file.is_file()]
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


def read_file(path: Path, known: Format, **told: Unpack[Told]) -> list[Clip | SkeletonMotion]:
    """The motions of one file of a known format."""
    return list(each_motion(path, known, **told))


def each_motion(path: Path, known: Format, **told: Unpack[Told]) -> Iterator[Clip | SkeletonMotion]:
    """The motions of one file of a known format, one after the other."""
    motion = known.read(path, **{name: value for name, value in told.items() if name in known.untold})
    for found in (motion,) if isinstance(motion, Clip | SkeletonMotion) else motion:
        if not RATES[0] <= found.fps <= RATES[1]:
            reason = f"{found.fps:.4g} frames per second; a motion has {RATES[0]:g} to {RATES[1]:g}"
            raise FormatError(path, found.name, reason)
        yield found


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
