"""What every reader asks of a value in a file: it is there, it is numbers of the right shape, all finite.

    poses = array(path, data, "poses", (None, 156))        # float64; None: any size, the first axis is frames
    fps = rate(path, data, "fps")
    quats = quaternions(path, "root_rot", poses[:, 3:7], "xyzw")

Each failure is a FormatError with the key, the frame and the value. No format is known here.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.error import FormatError

LIMIT = 2**26  # numbers in one array: half a gigabyte as float64, hours of motion
LARGEST = 1e6  # metres, radians or frames; more is damage
NUMBER = int | float | np.number
TOLERANCE = 0.02  # of a quaternion's norm; more is another quantity, not rounding


def array(path: Path, data: Mapping, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """data[key] as float64 of this shape; the first axis holds at least two frames when it is None."""
    if key not in data:
        raise FormatError(path, key, f"is missing; the file holds: {', '.join(map(str, data)) or 'nothing'}")
    value = numbers(path, key, data[key])
    fits = value.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, value.shape, strict=True))
    if not fits:
        wanted = tuple(("any" if at else "T") if n is None else n for at, n in enumerate(shape))
        raise FormatError(path, key, f"has shape {value.shape}; the format has {wanted}".replace("'", ""))
    if shape and shape[0] is None and len(value) < 2:
        raise FormatError(path, key, f"{len(value)} frames; a motion needs at least two")
    value = value.astype(np.float64)
    finite(path, key, value)
    return value


def finite(path: Path, where: str, value: np.ndarray) -> None:
    """Refuse nan, infinity and what no body does, naming the first."""
    good = np.abs(value) <= LARGEST  # nan is not
    if not good.all():
        place = tuple(int(i) for i in np.argwhere(~good)[0])
        number = value[place]
        kind = f"is beyond {LARGEST:g}" if np.isfinite(number) else "is not a finite number"
        raise FormatError(path, f"{where}{list(place)}", f"{number} {kind}")


def numbers(path: Path, where: str, value: object) -> np.ndarray:
    """An array, number, or list of rows of numbers as an array."""
    if isinstance(value, list):
        value = _rows(path, where, value)
    value = np.asarray(value) if isinstance(value, np.generic | int | float) else value
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise FormatError(path, where, f"is {kind}, not numbers")
    if value.size > LIMIT:
        raise FormatError(path, where, f"{value.size} numbers; arrays of more than {LIMIT} are not read")
    return value


def _rows(path: Path, where: str, rows: list) -> np.ndarray:
    """A list of numbers or of rows as an array. A pickle may repeat one row any number of times: sizes come first."""
    rows = [rows] if all(isinstance(x, NUMBER) for x in rows) else rows
    widths = {len(row) if isinstance(row, list | tuple | np.ndarray) else 0 for row in rows}
    if len(widths) != 1 or len(rows) * max(widths) > LIMIT:
        raise FormatError(path, where, f"rows of {sorted(widths)[:4]} numbers; all rows need the same count")
    if widths == {0} or not all(isinstance(x, NUMBER) for row in rows for x in row):
        raise FormatError(path, where, "holds something that is not a number")
    try:
        value = np.array(rows, dtype=np.float64)
    except OverflowError:
        raise FormatError(path, where, "holds a number beyond 1e308") from None
    return value[0] if len(value) == 1 else value


def rate(path: Path, data: Mapping, key: str) -> float:
    """Frames per second under a key: one positive number."""
    if key not in data:
        raise FormatError(path, key, f"is missing; the file holds: {', '.join(map(str, data)) or 'nothing'}")
    value = numbers(path, key, data[key])
    if value.size != 1 or not 0 < float(value.reshape(-1)[0]) < 1e5:
        raise FormatError(path, key, f"{value.tolist() if value.size < 4 else value.shape} is no frame rate")
    return float(value.reshape(-1)[0])


def quaternions(path: Path, where: str, q: np.ndarray, order: str) -> np.ndarray:
    """Unit quaternions wxyz of a file's (T, ..., 4) in `order` ("wxyz" or "xyzw"), signs aligned over time."""
    norm = np.linalg.norm(q, axis=-1)
    off = np.abs(norm - 1) > TOLERANCE
    if off.any():
        place = tuple(int(i) for i in np.argwhere(off)[0])
        reason = f"a quaternion of norm {norm[place]:.4g} is no rotation; are these its columns?"
        raise FormatError(path, f"{where}{list(place)}", reason)
    q = q / norm[..., None]
    return rotation.align(q[..., [3, 0, 1, 2]] if order == "xyzw" else q)
