"""ASF and AMC files (Acclaim, the CMU motion capture database): a skeleton, and a motion that refers to it by name.

    motion = read_amc(Path("01_01.amc"))                     # with 01.asf beside it
    motion = read_amc(Path("walk.amc"), Path("bodies/07.asf"), fps=60)

A bone turns by M, its degrees of freedom in their order (the first is applied first, about fixed axes), within its
own axis frame C: relative to the parent C M C^-1. A joint stands where its bone begins, which is where its parent's
ends; so the rest pose is that of the ASF, and the last bones' ends are dropped. ASF lengths are inches times the
"length" of its units (0.45 at CMU). The world is y up and is turned z up.

An AMC names no frame rate: it is FPS, CMU's, unless a SAMPLES-PER-SECOND line or the caller says otherwise.
Frames follow one another by number, and every one gives the same bones. Refused, with the line: anything
malformed, bones the ASF lacks, degrees of freedom that move or stretch a bone, a root with a frame of its own.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.error import FormatError
from kinetok.motion.formats.axes import ORDERS, from_euler, z_up
from kinetok.motion.formats.bvh import LIMIT, parse_number, read_lines
from kinetok.motion.formats.conventions import UNITS, family_of
from kinetok.motion.skeleton import SkeletonMotion

FPS = 120.0  # of the CMU database
ROOT_ORDER = {"TX", "TY", "TZ", "RX", "RY", "RZ"}
IGNORED = {"id", "limits", "bodymass", "cofmass"}


@dataclass(frozen=True, kw_only=True)
class Skeleton:
    """An ASF. names: root first, depth first; parents: index or -1; ends (J, 3): metres from the start of each bone to
    its end at rest; frames (J, 4): axis frames C; dofs: the axes of each bone's angles, "xyz", "xz", "" ...; order: of
    the root's six numbers; metres: per unit of the AMC's root path. All y up, as in the file."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    ends: np.ndarray
    frames: np.ndarray
    dofs: tuple[str, ...]
    order: tuple[str, ...]
    metres: float


def read_amc(path: Path, asf: Path | None = None, *, fps: float | None = None) -> SkeletonMotion:
    """Read a motion; `asf` is its skeleton, looked for beside it if left out; `fps` overrules file and FPS."""
    body = read_asf(asf or find_asf(path))
    rate, values = _frames(path, body)
    local = np.zeros((len(values), len(body.names), 4))
    local[..., 0] = 1
    place = [body.order.index(f"T{axis}") for axis in "XYZ"]
    turn = [column for column, name in enumerate(body.order) if name[0] == "R"]
    local[:, 0] = _turned(values[:, turn], "".join(body.order[column][1] for column in turn))
    column = len(body.order)
    for joint, dofs in enumerate(body.dofs[1:], start=1):
        turned = _turned(values[:, column : column + len(dofs)], dofs)
        frame = body.frames[joint]
        local[:, joint] = rotation.multiply(rotation.multiply(frame, turned), rotation.conjugate(frame))
        column += len(dofs)
    offsets = body.ends[list(body.parents)]
    offsets[0] = 0
    return SkeletonMotion(
        name=path.stem,
        fps=fps or rate,
        joints=body.names,
        parents=body.parents,
        offsets=z_up(offsets),
        local=rotation.align(z_up(local)),
        root=z_up(values[:, place]) * body.metres,
        family=family_of(body.names),
        unit="cmu" if np.isclose(body.metres, UNITS["cmu"]) else f"{body.metres / UNITS['in']:.4g} in",
        source=path.name,
    )


def find_asf(path: Path) -> Path:
    """The skeleton beside an AMC: of the same name, of its subject (01 of 01_05), or the only one in the folder."""
    there = sorted(each for each in path.parent.iterdir() if each.suffix.lower() == ".asf")
    for stem in (path.stem, path.stem.partition("_")[0]):
        for each in there:
            if each.stem.lower() == stem.lower():
                return each
    if len(there) == 1:
        return there[0]
    sought = " or ".join(dict.fromkeys(f"{stem}.asf" for stem in (path.stem, path.stem.partition("_")[0])))
    raise FormatError(
        path, "skeleton", f"no {sought} beside it ({len(there)} other .asf files there); name its ASF file"
    )


def read_asf(path: Path) -> Skeleton:
    """Read a skeleton."""
    sections = _sections(path)
    units = {words[0].lower(): (line, words) for line, words in sections.get("units", (0, []))[1]}
    line, words = units.get("length", (sections["units"][0], []))
    if len(words) != 2:
        raise FormatError(path, f"line {line}", "units need a length, as in 'length 0.45'")
    length = parse_number(path, f"line {line}", words[1])
    if not length > 0:
        raise FormatError(path, f"line {line}", f"length {words[1]} is not positive")
    metres = UNITS["in"] / length
    line, words = units.get("angle", (line, ["angle", "deg"]))
    if words[1:] not in (["deg"], ["rad"]):
        raise FormatError(path, f"line {line}", f"{' '.join(words)[:40]!r}: angles are 'deg' or 'rad'")
    scale = np.deg2rad(1) if words[1] == "deg" else 1.0
    order = _root(path, *sections["root"])
    bones = _bones(path, *sections["bonedata"], scale)
    parents = _hierarchy(path, *sections["hierarchy"], bones)
    names = _depth_first(parents)
    return Skeleton(
        names=names,
        parents=tuple(names.index(parents[name]) if name in parents else -1 for name in names),
        ends=np.array([bones[name].end if name in bones else (0, 0, 0) for name in names]) * metres,
        frames=np.array([bones[name].frame if name in bones else (1, 0, 0, 0) for name in names]),
        dofs=("", *(bones[name].dofs for name in names[1:])),
        order=order,
        metres=metres,
    )


@dataclass(frozen=True, kw_only=True)
class _Bone:
    line: int
    end: np.ndarray
    frame: np.ndarray
    dofs: str


Lines = list[tuple[int, list[str]]]


def _turned(angles: np.ndarray, axes: str) -> np.ndarray:
    """Rotations (T, 4) by angles (T, k) about fixed axes, the first applied first."""
    return from_euler(angles[:, ::-1], axes[::-1].upper())


def _sections(path: Path) -> dict[str, tuple[int, Lines]]:
    """Keyword (without the colon) -> its line and the words of the lines below it."""
    found: dict[str, tuple[int, Lines]] = {}
    body: Lines = []
    for number, line in enumerate(read_lines(path), start=1):
        words = line.partition("#")[0].split()
        if words and words[0].startswith(":"):
            key, body = words[0][1:].lower(), []
            if key in found:
                raise FormatError(path, f"line {number}", f"a second {words[0][:40]} section")
            found[key] = (number, body)
        elif words:
            body.append((number, words))
    for key in ("units", "root", "bonedata", "hierarchy"):
        if key not in found:
            raise FormatError(path, "sections", f"no :{key}; an ASF skeleton has :units, :root, :bonedata, :hierarchy")
    return found


def _root(path: Path, line: int, body: Lines) -> tuple[str, ...]:
    """The order of the root's numbers."""
    found = {words[0].lower(): (number, words[1:]) for number, words in body}
    number, order = found.get("order", (line, []))
    order = tuple(word.upper() for word in order)
    if set(order) != ROOT_ORDER or len(order) != len(ROOT_ORDER):
        raise FormatError(
            path, f"line {number}", f"the root's order is {' '.join(order)[:60]!r}, not TX TY TZ RX RY RZ"
        )
    for key in ("position", "orientation"):
        number, words = found.get(key, (line, []))
        if any(parse_number(path, f"line {number}", word) for word in words):
            raise FormatError(path, f"line {number}", f"the root's {key} is {' '.join(words)}; only 0 0 0 is supported")
    return order


def _bones(path: Path, line: int, body: Lines, scale: float) -> dict[str, _Bone]:
    """Name -> bone, of the blocks between begin and end; scale: radians per unit of angle."""
    bones: dict[str, _Bone] = {}
    inside: dict[str, tuple[int, list[str]]] | None = None
    begun, number = line, line
    for number, (key, *words) in body:
        key = key.lower()
        if key == "begin" and inside is None:
            inside, begun = {}, number
        elif key == "end" and inside is not None:
            name, bone = _bone(path, begun, inside, scale)
            if name in bones or name == "root":
                raise FormatError(path, f"line {begun}", f"two bones are named {name[:40]!r}")
            bones[name], inside = bone, None
        elif inside is None or key in ("begin", "end"):
            raise FormatError(path, f"line {number}", f"{key[:40]!r} where a bone's begin ... end belongs")
        elif key in ("name", "direction", "length", "axis", "dof"):
            if key in inside:
                raise FormatError(path, f"line {number}", f"a second {key} of the bone that begins at line {begun}")
            inside[key] = (number, words)
        elif key not in IGNORED and not key.startswith("("):  # limits go on over lines in brackets
            raise FormatError(path, f"line {number}", f"unknown word {key[:40]!r} in a bone")
    if inside is not None or not bones:
        raise FormatError(path, f"line {number}", "the file ends inside a bone" if bones or inside else "no bones")
    return bones


def _bone(path: Path, line: int, found: dict[str, tuple[int, list[str]]], scale: float) -> tuple[str, _Bone]:
    for key, count in (("name", 1), ("direction", 3), ("length", 1), ("axis", 4)):
        number, words = found.get(key, (line, []))
        if len(words) != count:
            raise FormatError(path, f"line {number}", f"a bone's {key} takes {count} values; here are {len(words)}")
    vector = {key: _numbers(path, *found[key]) for key in ("direction", "length")}
    number, (*angles, order) = found["axis"]
    if order.upper() not in ORDERS:
        raise FormatError(path, f"line {number}", f"axis order {order[:40]!r}; it is one of {', '.join(ORDERS)}")
    frame = _turned(scale * _numbers(path, number, angles)[None], order)[0]
    number, dofs = found.get("dof", (line, []))
    axes = [dof.lower() for dof in dofs]
    if not set(axes) <= {"rx", "ry", "rz"} or len(set(axes)) < len(axes):
        raise FormatError(
            path, f"line {number}", f"dof {' '.join(dofs)[:40]!r}; bones only turn: rx, ry, rz, each once"
        )
    norm = np.linalg.norm(vector["direction"])
    if not 0.99 < norm < 1.01 or vector["length"][0] < 0:
        raise FormatError(path, f"line {line}", f"a direction of length {norm:.4g}, a bone of {vector['length'][0]:g}")
    end = vector["direction"] / norm * vector["length"]
    return found["name"][1][0], _Bone(line=line, end=end, frame=frame, dofs="".join(axis[1] for axis in axes))


def _numbers(path: Path, line: int, words: list[str]) -> np.ndarray:
    return np.array([parse_number(path, f"line {line}", word) for word in words])


def _hierarchy(path: Path, line: int, body: Lines, bones: dict[str, _Bone]) -> dict[str, str]:
    """Bone -> parent, in the order of the file; every bone hangs from the root."""
    parents: dict[str, str] = {}
    for number, words in body:
        if words in (["begin"], ["end"]):
            continue
        if words[0] != "root" and words[0] not in parents:
            raise FormatError(path, f"line {number}", f"{words[0][:40]!r} has children but hangs from nothing yet")
        for name in words[1:]:
            if name not in bones or name in parents:
                what = "hangs from two bones" if name in parents else "is no bone of :bonedata"
                raise FormatError(path, f"line {number}", f"{name[:40]!r} {what}")
            parents[name] = words[0]
    loose = [name for name in bones if name not in parents]
    if loose:
        raise FormatError(path, f"line {bones[loose[0]].line}", f"bone {loose[0]!r} is not in the :hierarchy")
    return parents


def _depth_first(parents: dict[str, str]) -> tuple[str, ...]:
    found, waiting = [], ["root"]
    while waiting:
        found.append(waiting.pop())
        waiting += [name for name in reversed(parents) if parents[name] == found[-1]]
    return tuple(found)


def _frames(path: Path, body: Skeleton) -> tuple[float, np.ndarray]:
    """Frame rate, and values (T, columns): the root's six as in the file but radians, then each bone's angles."""
    lines = [(number, line.split()) for number, line in enumerate(read_lines(path), start=1)]
    lines = [(number, words) for number, words in lines if words and not words[0].startswith("#")]
    head = next((at for at, (_, words) in enumerate(lines) if not words[0].startswith(":")), len(lines))
    flags = {words[0][1:].upper(): (number, words[1:]) for number, words in lines[:head]}
    rate = FPS
    if "SAMPLES-PER-SECOND" in flags:
        number, words = flags["SAMPLES-PER-SECOND"]
        rate = parse_number(path, f"line {number}", " ".join(words))
        if not rate > 0:
            raise FormatError(path, f"line {number}", f"{rate:g} samples per second")
    scale = 1.0 if "RADIANS" in flags else np.deg2rad(1)
    widths = {"root": len(body.order)} | dict(zip(body.names[1:], map(len, body.dofs[1:]), strict=True))
    moved = {name: width for name, width in widths.items() if width}
    start = dict(zip(moved, np.cumsum([0, *moved.values()])[:-1].tolist(), strict=True))
    rows = [_frame(path, frame, moved, start) for frame in _split(path, lines[head:])]
    if len(rows) < 2:
        raise FormatError(path, f"line {lines[-1][0] if lines else 1}", f"{len(rows)} frames; a motion needs two")
    try:
        values = np.array(rows, dtype=np.float64)
    except ValueError:
        values = np.array([[np.nan]])
    if not (np.abs(values) < LIMIT).all():  # which line it is matters only now
        for number, (name, *words) in lines[head:]:
            for word in words:
                parse_number(path, f"line {number}", word, name)
    angles = np.array([name[0] == "R" for name in body.order] + [True] * (values.shape[1] - len(body.order)))
    values[:, angles] *= scale
    return rate, values


def _split(path: Path, lines: Lines) -> Iterator[Lines]:
    """The lines of each frame, its number first; numbers go up by one."""
    starts = [at for at, (_, words) in enumerate(lines) if len(words) == 1 and re.fullmatch(r"\d{1,12}", words[0])]
    if lines and starts[:1] != [0]:
        raise FormatError(path, f"line {lines[0][0]}", f"{' '.join(lines[0][1])[:40]!r} where a frame number belongs")
    stops = [*starts[1:], len(lines)][: len(starts)]
    for index, (at, stop) in enumerate(zip(starts, stops, strict=True)):
        wanted = int(lines[starts[0]][1][0]) + index
        if int(lines[at][1][0]) != wanted:
            raise FormatError(path, f"line {lines[at][0]}", f"frame {lines[at][1][0]} where frame {wanted} belongs")
        yield lines[at:stop]


def _frame(path: Path, lines: Lines, widths: dict[str, int], start: dict[str, int]) -> list[str]:
    """The words of one frame in the order of the skeleton."""
    row = [""] * sum(widths.values())
    seen = set()
    for number, (name, *words) in lines[1:]:
        if name not in widths or name in seen:
            what = "a second time in this frame" if name in seen else "is no bone with degrees of freedom in the ASF"
            raise FormatError(path, f"line {number}", f"{name[:40]!r} {what}")
        if len(words) != widths[name]:
            reason = f"{len(words)} numbers of {name!r}; the ASF gives it {widths[name]}"
            raise FormatError(path, f"line {number}", reason)
        at = start[name]
        row[at : at + len(words)] = words
        seen.add(name)
    if len(seen) < len(widths):
        missing = next(name for name in widths if name not in seen)
        raise FormatError(path, f"line {lines[0][0]}", f"frame {lines[0][1][0]} gives no values of {missing!r}")
    return row
