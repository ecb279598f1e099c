"""Unitree G1 motion as CSV, in its three dialects; the clip is of the character "g1".

    clip = read_robot_csv(Path("dance1.csv"), fps=60)
    write_robot_csv(Path("dance1.csv"), clip.resample(30), dialect="lafan1")

| dialect    | header | columns                                                          | units   | fps |
|------------|--------|------------------------------------------------------------------|---------|-----|
| lafan1     | no     | 36: root xyz, quaternion x y z w, 29 joints                      | m, rad  | 30  |
| kimodo     | no     | 36: root xyz, quaternion w x y z, 29 joints                      | m, rad  | 30  |
| bones-seed | yes    | Frame, root_translateX.., root_rotateX.. (extrinsic xyz), <joint>_dof | cm, deg | 120 |

lafan1 and kimodo look alike: the feet on the ground decide (see g1.quaternion_order), and a motion that fits both is
refused until `dialect` says which. No dialect states its frame rate: without `fps` the dialect's own is assumed,
which nothing in the file can confirm, and `Clip.source` says so. Joint columns of a header are found by name.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kinetok.config import nearest
from kinetok.motion.clip import Clip
from kinetok.motion.error import FormatError
from kinetok.motion.formats.axes import from_euler, to_euler
from kinetok.motion.formats.fields import finite, quaternions
from kinetok.motion.formats.g1 import JOINTS, g1_clip, load_g1, quaternion_order

COLUMNS = 36
TRANSLATE = ("root_translateX", "root_translateY", "root_translateZ")
ROTATE = ("root_rotateX", "root_rotateY", "root_rotateZ")


@dataclass(frozen=True)
class Dialect:
    """fps: the rate its makers use; order: of the quaternion, or "" for the Euler angles of a header."""

    fps: float
    order: str


DIALECTS = {
    "lafan1": Dialect(30.0, "xyzw"),
    "kimodo": Dialect(30.0, "wxyz"),
    "bones-seed": Dialect(120.0, ""),
}


def is_robot_csv(path: Path) -> bool:
    """True when the first line is all numbers or a header that names the root's columns."""
    with path.open("rb") as file:
        first = file.readline(8192).decode("utf-8-sig", errors="replace")
    cells = [cell.strip() for cell in first.split(",")]
    return TRANSLATE[0] in cells or (len(cells) > 1 and all(_is_number(cell) for cell in cells))


def read_robot_csv(path: Path, *, dialect: str | None = None, fps: float | None = None, character: str = "g1") -> Clip:
    """Read one file. dialect: a key of DIALECTS, told from the file when None; fps: its frame rate."""
    if dialect is not None and dialect not in DIALECTS:
        raise ValueError(f"unknown dialect {dialect!r}{nearest(dialect, DIALECTS)}; one of: {', '.join(DIALECTS)}")
    header, values = _parse(path)
    if header:
        if dialect not in (None, "bones-seed"):
            raise FormatError(path, "line 1", f"has a header; {dialect!r} files have none")
        dialect, told = "bones-seed", "by its header"
        root, quats, joints = _columns(path, header, values)
    else:
        if dialect == "bones-seed":
            raise FormatError(path, "line 1", "has no header; a bones-seed file names its columns")
        if values.shape[1] != COLUMNS:
            reason = f"{values.shape[1]} columns; the format has {COLUMNS} (xyz, quaternion, 29 joints)"
            raise FormatError(path, "line 1", reason)
        root, raw, joints = values[:, :3], values[:, 3:7], values[:, 7:]
        quaternions(path, "columns 3-6", raw, "wxyz")
        told = "as asked" if dialect else "by the ground"
        dialect = dialect or _by_ground(path, root, raw, joints, character)
        quats = quaternions(path, "columns 3-6", raw, DIALECTS[dialect].order)
    rate = f"{fps:g} fps as asked" if fps else f"{DIALECTS[dialect].fps:g} fps assumed"
    return g1_clip(
        path,
        fps=fps or DIALECTS[dialect].fps,
        root=root,
        quats=quats,
        joints=joints,
        source=f"{path.name} ({dialect} {told}, {rate})",
        character=character,
    )


def write_robot_csv(path: Path, clip: Clip, *, dialect: str = "lafan1") -> None:
    """Write a clip of the G1. Its rate must be the dialect's, since the file cannot carry another."""
    if dialect not in DIALECTS:
        raise ValueError(f"unknown dialect {dialect!r}{nearest(dialect, DIALECTS)}; one of: {', '.join(DIALECTS)}")
    load_g1(clip.character)
    shape = DIALECTS[dialect]
    if abs(clip.fps / shape.fps - 1) > 1e-3:
        raise ValueError(
            f"clip {clip.name!r}: {clip.fps:g} fps, but {dialect} files carry no rate and are read at {shape.fps:g}; "
            f"write clip.resample({shape.fps:g})"
        )
    root, quats, joints = clip.qpos[:, :3], clip.qpos[:, 3:7], clip.qpos[:, 7:]
    header = ""
    if shape.order:
        rows = np.concatenate([root, quats[:, [1, 2, 3, 0]] if shape.order == "xyzw" else quats, joints], axis=1)
    else:
        angles = np.unwrap(to_euler(quats, "ZYX")[:, ::-1], axis=0)
        frame = np.arange(len(root))[:, None]
        rows = np.concatenate([frame, 100 * root, np.rad2deg(angles), np.rad2deg(joints)], axis=1)
        header = ",".join(["Frame", *TRANSLATE, *ROTATE, *(f"{name}_joint_dof" for name in JOINTS)]) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(header)
        np.savetxt(file, rows, fmt="%.9f" if shape.order else ["%d"] + ["%.9f"] * 35, delimiter=",")
    os.replace(temporary, path)


def _parse(path: Path) -> tuple[list[str], np.ndarray]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FormatError(path, f"byte {error.start}", "not text; a CSV is UTF-8") from None
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise FormatError(path, "file", "is empty")
    cells = [cell.strip() for cell in lines[0].split(",")]
    header = [] if all(_is_number(cell) for cell in cells) else cells
    rows = lines[1:] if header else lines
    if header:
        _place(path, header)
    if len(rows) < 2:
        raise FormatError(path, "file", f"{len(rows)} frames; a motion needs at least two")
    try:
        values = np.loadtxt(rows, delimiter=",", comments=None, ndmin=2)
    except ValueError as error:
        raise _bad_row(path, rows, len(cells), 2 if header else 1) or FormatError(path, "file", str(error)) from None
    if len(values) != len(rows) or values.shape[1] != len(cells):
        raise _bad_row(path, rows, len(cells), 2 if header else 1) or FormatError(path, "file", "rows are missing")
    finite(path, "row, column ", values)
    return header, values


def _bad_row(path: Path, rows: list[str], width: int, first: int) -> FormatError | None:
    for index, row in enumerate(rows):
        cells = row.split(",")
        if len(cells) != width:
            return FormatError(path, f"line {index + first}", f"{len(cells)} columns; the lines before have {width}")
        bad = next((cell for cell in cells if not _is_number(cell)), None)
        if bad is not None:
            return FormatError(path, f"line {index + first}, column {cells.index(bad)}", f"{bad!r} is not a number")
    return None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _place(path: Path, header: list[str]) -> dict[str, int]:
    """Column of each name in a header."""
    names = {name.removesuffix("_dof").removesuffix("_joint"): index for index, name in enumerate(header)}
    missing = [name for name in (*TRANSLATE, *ROTATE, *JOINTS) if name not in names]
    if missing:
        lacks = f"the header lacks {', '.join(missing[:5])}{', ...' * (len(missing) > 5)}"
        if len(missing) == len((*TRANSLATE, *ROTATE, *JOINTS)):
            lacks = (
                "neither numbers nor BONES-SEED's names; without a header a row is 36 numbers with commas between: "
                "root x y z, quaternion, 29 joints (docs/formats.md)"
            )
        raise FormatError(path, "line 1", lacks)
    if len(names) != len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise FormatError(path, "line 1", f"two columns are named {twice!r}")
    return names


def _columns(path: Path, header: list[str], values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Root (T, 3) m, quaternions and joints rad of a file with a header, by the names in it."""
    names = _place(path, header)
    root = values[:, [names[name] for name in TRANSLATE]] / 100
    angles = np.deg2rad(values[:, [names[name] for name in reversed(ROTATE)]])
    quats = quaternions(path, "root_rotate", from_euler(angles, "ZYX"), "wxyz")
    return root, quats, np.deg2rad(values[:, [names[name] for name in JOINTS]])


def _by_ground(path: Path, root: np.ndarray, raw: np.ndarray, joints: np.ndarray, character: str) -> str:
    order = quaternion_order(root, raw, joints, character)
    if not order:
        reason = "the motion fits x y z w and w x y z alike; say which: --dialect lafan1 or kimodo (dialect=)"
        raise FormatError(path, "columns 3-6", reason)
    return next(name for name, dialect in DIALECTS.items() if dialect.order == order)
