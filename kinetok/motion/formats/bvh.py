"""BVH files: a skeleton of offsets and Euler channels, then one line of numbers per frame.

    motion = read_bvh(Path("walk.bvh"))                      # metres, z up, whatever the file's unit and up axis
    write_bvh(Path("copy.bvh"), motion)                      # centimetres, y up

A joint's channel order is its intrinsic rotation order; orders may differ within a file. Position channels stand
in place of OFFSET and are not added to it. A joint below the root may have them if they hold still; a root that only
carries a single moving joint is folded into it. End Sites serve to measure the body and are dropped. Angles stay as
they are recorded: no resampling, no cut of a leading T-pose, no turn of the character's facing. The rest pose is
turned z up as well, even where the file keeps a y-up rig in a z-up world.

BVH names neither unit nor up axis; `conventions` says how they are found, and `unit` when they are guessed. Files of
`write_bvh` need no guess: all their End Sites lie at RULER, one centimetre off, in a direction no other program uses.

Refused, with the line: anything malformed, values that are not finite, two joints of one name, bones that change
their length. The reader allocates by the lines that are there, never by what the header claims.
"""

import os
import re
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.error import FormatError
from kinetok.motion.formats.axes import ORDERS, from_euler, to_euler, y_up, z_up
from kinetok.motion.formats.conventions import UNITS, family_of, leg_length, rest_pose, unit_of, up_axes
from kinetok.motion.skeleton import SkeletonMotion

RULER = (0.0, 0.6, 0.8)  # every End Site of our own files, centimetres
STILL = 1e-3  # of the body's size: a bone that varies less has a fixed length
LIMIT = 1e9  # a larger number is no length, angle or count
END = -2
CHANNELS = {f"{axis}{kind}".upper(): f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ"}


def read_bvh(path: Path, *, unit: str | None = None, up: str | None = None) -> SkeletonMotion:
    """Read one file. `unit` (a key of UNITS) and `up` ("y" or "z") overrule what the reader would find out."""
    if unit is not None and unit not in UNITS:
        raise ValueError(f"unit {unit!r}; known units: {', '.join(UNITS)}")
    if up is not None and up not in ("y", "z"):
        raise ValueError(f"up axis {up!r}; it is 'y' or 'z'")
    tree, fps, values = _parse(path)
    tree, offsets, local, root = _fold(path, tree, *_channels(tree, values))
    motion = SkeletonMotion(
        name=path.stem,
        fps=fps,
        joints=tuple(tree.names),
        parents=tuple(tree.parents),
        offsets=offsets,
        local=local,
        root=root,
        family=family_of(tree.names),
        source=path.name,
    )
    ours = bool(tree.ends) and all(end == RULER for _, end in tree.ends)
    world, rest = ("y", "y") if ours else up_axes(motion)
    up = up or world
    rest = rest or up
    if unit is None and ours:
        unit = "cm"
    if unit is None:
        joints = rest_pose(tree.parents, offsets)
        body = np.concatenate([joints, *(joints[joint, None] + end for joint, end in tree.ends)])
        unit, metres = unit_of(motion.family, leg_length(motion), float(np.ptp(body, axis=0)["xyz".index(rest)]))
    else:
        metres = UNITS[unit]
    offsets, local, root = _stand(offsets * metres, local, root * metres, up, rest)
    return replace(motion, offsets=offsets, local=rotation.align(local), root=root, unit=unit)


def write_bvh(path: Path, motion: SkeletonMotion, *, order: str = "ZXY") -> None:
    """Write a motion in centimetres, y up; the file appears whole or not at all.

    order: intrinsic rotation order of every joint. Joints are written depth first, which is the order they will
    have when read back. Angles run on beyond 180 degrees rather than jump.
    """
    if order not in ORDERS:
        raise ValueError(f"rotation order {order!r}; it is one of {', '.join(ORDERS)}")
    for name in motion.joints:
        if not name or name != " ".join(name.split()) or set(name) & set("{}"):
            raise ValueError(f"motion {motion.name!r}: joint {name!r} has a name that BVH cannot hold")
    depth, header = _depth_first(motion.parents), ["HIERARCHY"]
    offsets = y_up(motion.offsets) / UNITS["cm"]
    offsets[0] = 0
    open_joints: list[int] = []
    for joint in depth:
        while open_joints and open_joints[-1] != motion.parents[joint]:
            open_joints.pop()
            header.append("\t" * len(open_joints) + "}")
        tab = "\t" * len(open_joints)
        turns = " ".join(f"{axis}rotation" for axis in order)
        header += [f"{tab}{'JOINT' if open_joints else 'ROOT'} {motion.joints[joint]}", tab + "{"]
        header.append(f"{tab}\tOFFSET " + " ".join(f"{x:.6f}" for x in offsets[joint]))
        moves = "" if open_joints else "Xposition Yposition Zposition "
        header.append(f"{tab}\tCHANNELS {3 if open_joints else 6} {moves}{turns}")
        if joint not in motion.parents:
            end = " ".join(f"{x:.6f}" for x in RULER)
            header += [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET {end}", f"{tab}\t}}"]
        open_joints.append(joint)
    header += ["\t" * level + "}" for level in reversed(range(len(open_joints)))]
    header += ["MOTION", f"Frames: {len(motion.root)}", f"Frame Time: {1 / motion.fps:.15f}"]
    angles = to_euler(y_up(motion.local[:, depth]), order)
    angles = np.rad2deg(np.unwrap(angles, axis=0)).reshape(len(motion.root), -1)
    values = np.concatenate([y_up(motion.root) / UNITS["cm"], angles], axis=1)
    form = " ".join(["%.6f"] * values.shape[1])
    text = "\n".join([*header, *(form % tuple(row) for row in values.tolist()), ""])
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        draft.write_text(text, encoding="utf-8", newline="\n")
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def read_lines(path: Path) -> list[str]:
    """The lines of a UTF-8 text with any mix of line ends; refused, with the line: other bytes, an empty file."""
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        remedy = (
            "save it as UTF-8, e.g. iconv -f utf-16 -t utf-8"
            if data[:2] in (b"\xff\xfe", b"\xfe\xff")
            else "if its names are in Latin-1: iconv -f latin1 -t utf-8"
        )
        reason = f"byte 0x{data[error.start]:02x} is not UTF-8 text; {remedy}"
        raise FormatError(path, f"line {line}", reason) from None
    if not text.strip():
        raise FormatError(path, "line 1", "the file is empty")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def parse_number(path: Path, place: str, word: str, label: str = "") -> float:
    """A finite number below LIMIT; `label` says what it is of, for the error."""
    try:
        value = float(word) if word.isascii() and "_" not in word else np.nan
    except ValueError:
        value = np.nan
    if not abs(value) < LIMIT:
        raise FormatError(path, place, f"{word[:40]!r}{f' ({label})' if label else ''} is not a finite number")
    return value


@dataclass(frozen=True, kw_only=True)
class _Tree:
    """The HIERARCHY: per joint a name, parent, OFFSET, channels and line; ends: (joint, OFFSET) of each End Site."""

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[tuple[float, ...] | None] = field(default_factory=list)
    channels: list[tuple[str, ...] | None] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    ends: list[tuple[int, tuple[float, ...]]] = field(default_factory=list)


def _parse(path: Path) -> tuple[_Tree, float, np.ndarray]:
    """The hierarchy, the frame rate and the numbers (T, channels)."""
    lines = read_lines(path)
    motion = next((n for n, line in enumerate(lines) if line.strip().upper() == "MOTION"), len(lines))
    tree = _hierarchy(path, lines[:motion])
    if motion == len(lines):
        raise FormatError(path, f"line {len(lines)}", "the file ends without a MOTION section")
    rows = [n for n in range(motion + 1, len(lines)) if lines[n].strip()]
    count, counted = _header(path, lines, rows[:1], r"Frames\s*:\s*(\S+)", "Frames: <count>", motion)
    if not re.fullmatch(r"\d{1,18}", count) or int(count) < 2:
        raise FormatError(path, counted, f"{count[:40]!r} frames; a motion needs a count of at least two")
    token, place = _header(path, lines, rows[1:2], r"Frame\s+Time\s*:\s*(\S+)", "Frame Time: <seconds>", motion)
    fps = _fps(path, place, token)
    rows = rows[2:]
    values = _values(path, tree, lines, rows)
    if len(rows) != int(count):
        raise FormatError(path, counted, f"Frames says {count}, but {len(rows)} lines of numbers follow")
    return tree, fps, values


def _header(path: Path, lines: list[str], rows: list[int], pattern: str, form: str, motion: int) -> tuple[str, str]:
    """The value of one line of the MOTION section's head, and its place."""
    line = rows[0] if rows else motion
    found = re.fullmatch(pattern, lines[line].strip(), re.IGNORECASE)
    if not rows or not found:
        raise FormatError(path, f"line {line + 1}", f"{lines[line].strip()[:40]!r} where {form!r} belongs")
    return found[1], f"line {line + 1}"


def _fps(path: Path, place: str, token: str) -> float:
    """Frames per second. A frame time cut to few digits (.0083333) means the whole or NTSC rate that it abbreviates."""
    seconds = parse_number(path, place, token)
    if not 1 / LIMIT < seconds < LIMIT:
        raise FormatError(path, place, f"Frame Time {token} is no positive time")
    exponent = Decimal(token).as_tuple().exponent
    half = 0.5 * 10.0 ** (exponent if isinstance(exponent, int) else 0)
    for fps in (round(1 / seconds), round(1.001 / seconds) / 1.001):
        if fps and abs(1 / fps - seconds) <= half + 1e-15 and abs(fps * seconds - 1) < 1e-3:
            return float(fps)
    return 1 / seconds


def _values(path: Path, tree: _Tree, lines: list[str], rows: list[int]) -> np.ndarray:
    """The numbers (T, channels) of the lines `rows`."""
    labels = [
        f"{channel} of {name!r}" for name, each in zip(tree.names, tree.channels, strict=True) for channel in each or ()
    ]
    if not labels:
        raise FormatError(path, f"line {tree.lines[0]}", "no joint has a channel; there is no motion")
    if len(rows) < 2:
        raise FormatError(path, f"line {len(lines)}", f"{len(rows)} frames; a motion needs at least two")
    try:
        values = np.loadtxt([lines[n] for n in rows], comments=None, ndmin=2)
    except ValueError:
        values = np.empty((0, 0))
    if values.shape != (len(rows), len(labels)):  # which line it is matters only now
        for n in rows:
            words = lines[n].split()
            if len(words) != len(labels):
                reason = f"{len(words)} numbers; the hierarchy has {len(labels)} channels"
                raise FormatError(path, f"line {n + 1}", reason)
            for index, word in enumerate(words):
                parse_number(path, f"line {n + 1}, value {index + 1}", word, labels[index])
        raise FormatError(path, f"line {rows[0] + 1}", "these lines do not make a table of numbers")
    if not (np.abs(values) < LIMIT).all():
        frame, column = np.argwhere(~(np.abs(values) < LIMIT))[0]
        reason = f"{values[frame, column]:g} ({labels[column]}) is no length or angle"
        raise FormatError(path, f"line {rows[frame] + 1}, value {column + 1}", reason)
    return values


class _Words:
    """The hierarchy's words, taken one after another; `line` is that of the last one taken."""

    def __init__(self, path: Path, lines: list[str]):
        self.path, self.at, self.line = path, 0, 1
        self.words = [
            (word, number)
            for number, line in enumerate(lines, start=1)
            for word in line.replace("{", " { ").replace("}", " } ").split()
        ]

    def more(self) -> bool:
        return self.at < len(self.words)

    def next(self) -> str:
        word, self.line = self.words[self.at]
        self.at += 1
        return word

    def rest(self, count: int | None = None) -> list[str]:
        """The next `count` words of this line, or all of them up to a brace."""
        stop = self.at
        while stop < len(self.words) and self.words[stop][1] == self.line and self.words[stop][0] not in "{}":
            stop += 1
        stop = stop if count is None else min(stop, self.at + count)
        found = [word for word, _ in self.words[self.at : stop]]
        if count is not None and len(found) < count:
            raise self.error(f"{len(found)} values where {count} belong")
        self.at = stop
        return found

    def error(self, reason: str) -> FormatError:
        return FormatError(self.path, f"line {self.line}", reason)


def _hierarchy(path: Path, lines: list[str]) -> _Tree:
    """The tree; every brace is closed, every joint has OFFSET and CHANNELS."""
    words, tree = _Words(path, lines), _Tree()
    if not words.more() or words.next().upper() != "HIERARCHY":
        raise words.error("a BVH file begins with HIERARCHY")
    open_: list[int] = []  # the joints whose braces are open, END for an End Site
    while words.more():
        word = words.next()
        kind, inside = word.upper(), open_[-1] if open_ else None
        if kind in ("ROOT", "JOINT", "END"):
            open_.append(_open(words, tree, kind, inside))
        elif inside is None:
            raise words.error(f"{word[:40]!r} outside the braces of a ROOT")
        elif kind == "}":
            open_.pop()
        elif kind == "OFFSET":
            offset = tuple(parse_number(path, f"line {words.line}", each, "OFFSET") for each in words.rest(3))
            if inside == END:
                tree.ends.append((open_[-2], offset))
            else:
                _once(words, tree, tree.offsets, inside)
                tree.offsets[inside] = offset
        elif kind == "CHANNELS" and inside != END:
            _once(words, tree, tree.channels, inside)
            tree.channels[inside] = _channel_names(words)
        else:
            raise words.error(f"{word[:40]!r} where OFFSET, CHANNELS, JOINT, End Site or a brace belongs")
    if open_:
        inside = "an End Site" if open_[-1] == END else f"joint {tree.names[open_[-1]]!r}"
        raise words.error(f"the hierarchy ends inside {inside}; a '}}' is missing")
    if not tree.names:
        raise words.error("the hierarchy holds no ROOT")
    for what, values in (("OFFSET", tree.offsets), ("CHANNELS", tree.channels)):
        if None in values:
            joint = values.index(None)
            raise FormatError(path, f"line {tree.lines[joint]}", f"joint {tree.names[joint]!r} has no {what} line")
    return tree


def _open(words: _Words, tree: _Tree, kind: str, inside: int | None) -> int:
    """A joint or End Site up to its brace; returns the joint's index or END."""
    line, name = words.line, " ".join(words.rest())
    if (kind == "ROOT") != (inside is None) or inside == END or (kind == "ROOT" and tree.names):
        raise words.error(f"{kind} {name[:40]} does not belong here: a file holds one ROOT and all else inside it")
    if not words.more() or words.next() != "{":
        raise FormatError(words.path, f"line {line}", f"{kind} {name[:40]} is not followed by a '{{'")
    if kind == "END":
        return END
    if not name or name in tree.names:
        reason = f"two joints are named {name[:40]!r}; rename one" if name else "a joint without a name"
        raise FormatError(words.path, f"line {line}", reason)
    tree.names.append(name)
    tree.parents.append(-1 if inside is None else inside)
    tree.offsets.append(None)
    tree.channels.append(None)
    tree.lines.append(line)
    return len(tree.names) - 1


def _once(words: _Words, tree: _Tree, values: list, joint: int) -> None:
    if values[joint] is not None:
        raise words.error(f"a second such line of joint {tree.names[joint]!r}")


def _channel_names(words: _Words) -> tuple[str, ...]:
    (count,) = words.rest(1)
    if not re.fullmatch(r"[0-6]", count):
        raise words.error(f"{count[:40]!r} channels; a joint has 0 to 6")
    names = words.rest(int(count))
    for name in names:
        if name.upper() not in CHANNELS:
            raise words.error(f"unknown channel {name[:40]!r}; known: {', '.join(CHANNELS.values())}")
    channels = tuple(CHANNELS[name.upper()] for name in names)
    if len(set(channels)) < len(channels):
        raise words.error(f"a channel twice in {' '.join(channels)}")
    return channels


def _channels(tree: _Tree, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (T, J, 4) and positions (T, J, 3), relative to the parent, in the file's axes and unit."""
    local = np.zeros((len(values), len(tree.names), 4))
    places = np.tile(np.array(tree.offsets, dtype=float), (len(values), 1, 1))
    alike: dict[str, list[tuple[int, list[int]]]] = {}
    column = 0
    for joint, channels in enumerate(tree.channels):
        turns = [(channel[0], column + index) for index, channel in enumerate(channels or ()) if "rot" in channel]
        alike.setdefault("".join(axis for axis, _ in turns), []).append((joint, [at for _, at in turns]))
        for index, channel in enumerate(channels or ()):
            if "pos" in channel:
                places[:, joint, "XYZ".index(channel[0])] = values[:, column + index]
        column += len(channels or ())
    for order, members in alike.items():
        columns = np.array([at for _, at in members], dtype=int).reshape(len(members), len(order))
        local[:, [joint for joint, _ in members]] = from_euler(np.deg2rad(values[:, columns]), order)
    return local, places


def _fold(
    path: Path, tree: _Tree, local: np.ndarray, places: np.ndarray
) -> tuple[_Tree, np.ndarray, np.ndarray, np.ndarray]:
    """Offsets (J, 3), rotations (T, J, 4) and root path (T, 3); a root whose one child moves freely is left out."""
    written, usual = np.array(tree.offsets, dtype=float), np.median(places, axis=0)
    still = STILL * max(float(np.ptp(rest_pose(tree.parents, each), axis=0).max()) for each in (written, usual))
    moving = np.abs(places - usual).max(axis=(0, 2)) > still
    while len(tree.names) > 1 and moving[1] and tree.parents.count(0) == 1:
        places[:, 1] = places[:, 0] + rotation.rotate(local[:, 0], places[:, 1])
        local[:, 1] = rotation.multiply(local[:, 0], local[:, 1])
        tree, local, places = _without_root(tree), local[:, 1:], places[:, 1:]
        written, moving = written[1:], moving[1:]
    positioned = [j for j, each in enumerate(tree.channels) if j and any("pos" in channel for channel in each or ())]
    for joint in positioned:
        if moving[joint]:
            span = np.ptp(places[:, joint], axis=0).max()
            reason = f"the position channels of {tree.names[joint]!r} vary by {span:.3g} units over time"
            reason += "; kinetok reads bones of fixed length: bake the motion into rotations first"
            raise FormatError(path, f"line {tree.lines[joint]}", reason)
    offsets = np.median(places, axis=0)
    if positioned and np.abs(offsets[positioned]).max() <= still:  # channels that count from OFFSET
        offsets[positioned] = written[positioned]
    offsets[0] = 0
    return tree, offsets, local, places[:, 0]


def _without_root(tree: _Tree) -> _Tree:
    return _Tree(
        names=tree.names[1:],
        parents=[parent - 1 for parent in tree.parents[1:]],
        offsets=tree.offsets[1:],
        channels=tree.channels[1:],
        lines=tree.lines[1:],
        ends=[(joint - 1, end) for joint, end in tree.ends if joint],
    )


def _stand(
    offsets: np.ndarray, local: np.ndarray, root: np.ndarray, up: str, rest: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World and rest pose turned z up.

    Joint frames may be chosen freely, so the rest pose can be turned apart from the world. With W and C the turns of
    world and rest: offsets C o, local C R C^-1 below the root, and W R C^-1 at the root.
    """
    offsets, local = (z_up(offsets), z_up(local)) if rest == "y" else (offsets, local.copy())
    if up != rest:
        tilt = np.sqrt(0.5) * np.array([1, 1 if up == "y" else -1, 0, 0])  # about x, from y up to z up or back
        local[:, 0] = rotation.multiply(tilt, local[:, 0])
    return offsets, local, z_up(root) if up == "y" else root


def _depth_first(parents: tuple[int, ...]) -> list[int]:
    children: list[list[int]] = [[] for _ in parents]
    for joint, parent in enumerate(parents[1:], start=1):
        children[parent].append(joint)
    found, waiting = [], [0]
    while waiting:
        found.append(waiting.pop())
        waiting += reversed(children[found[-1]])
    return found
