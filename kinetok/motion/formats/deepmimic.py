"""DeepMimic motion files: JSON with "Loop" and "Frames", each frame a duration and 43 numbers.

    clip = read_deepmimic(Path("humanoid3d_walk.txt"))

The file is y up and faces +x; its joints are those of the built-in humanoid. Reading normalises the
quaternions, aligns their signs, resamples uneven frame durations to the median rate, closes the cycle of a
"wrap" loop over its last quarter second (many files miss their own start by up to one radian) and puts every
frame on the ground (`motion.ground`; some float by 0.1 m). Refused, naming file, frame and column: anything but
numbers, other column counts, values that are not finite or beyond a million, zero quaternions, fewer than two
frames of positive duration.
"""

import json
from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip, close_loop, interpolate
from kinetok.motion.error import FormatError
from kinetok.motion.ground import floor_height

COLUMNS = 44
# file order: joint name in our MJCF, width in the file, sign of a hinge
JOINTS = (
    ("chest", 4, 0), ("neck", 4, 0),
    ("right_hip", 4, 0), ("right_knee", 1, -1), ("right_ankle", 4, 0), ("right_shoulder", 4, 0), ("right_elbow", 1, 1),
    ("left_hip", 4, 0), ("left_knee", 1, -1), ("left_ankle", 4, 0), ("left_shoulder", 4, 0), ("left_elbow", 1, 1),
)  # fmt: skip
CLOSE_SECONDS = 0.25
NORM_OFF = 0.05  # the files' three or four digits leave less
LARGEST = 1e6
STRETCH = 100  # times the frames of the file: more than that does resampling not make


def is_deepmimic(path: Path) -> bool:
    """True when the file's first bytes look like this format."""
    if path.suffix.lower() not in (".txt", ".json"):
        return False
    with path.open("rb") as file:
        head = file.read(200)
    return b'"Loop"' in head or b'"Frames"' in head


def read_deepmimic(path: Path, *, close: bool = True) -> Clip:
    """Read one file as a clip of the built-in humanoid."""
    loop, frames = _parse(path)
    body = Character.load("humanoid")
    qpos, durations = _to_qpos(path, body, frames[:, 1:]), frames[:-1, 0]
    keep = np.concatenate([[True], durations > 0])
    qpos, times = qpos[keep], np.cumsum(np.concatenate([[0], durations[durations > 0]]))
    if len(qpos) < 2:
        raise FormatError(path, "Frames", "fewer than two frames of positive duration; there is no motion")
    fps = 1 / float(np.median(np.diff(times)))
    if np.ptp(np.diff(times)) > 1e-6:
        qpos = _resample(path, body, qpos, times, fps)
    if loop and close:
        qpos = close_loop(body, qpos, max(1, round(CLOSE_SECONDS * fps)))
    qpos[:, 2] -= floor_height(body, qpos, fps, loop=loop and close)
    name, source = path.stem.removeprefix("humanoid3d_"), path.name + _renormed(frames[:, 1:])
    return Clip(name=name, character="humanoid", fps=fps, qpos=qpos, loop=loop, source=source)


def _parse(path: Path) -> tuple[bool, np.ndarray]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise FormatError(path, f"line {getattr(error, 'lineno', '?')}", f"not JSON: {error}") from None
    if not isinstance(data, dict) or "Frames" not in data:
        raise FormatError(path, "top level", 'no "Frames"; a DeepMimic file is {"Loop": ..., "Frames": [[...], ...]}')
    loop = data.get("Loop", "none")
    if loop not in ("wrap", "none"):
        raise FormatError(path, "Loop", f'{loop!r}; it is "wrap" or "none"')
    rows = data["Frames"]
    if not isinstance(rows, list) or len(rows) < 2:
        raise FormatError(path, "Frames", "needs a list of at least two frames")
    for index, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != COLUMNS:
            size = len(row) if isinstance(row, list) else type(row).__name__
            raise FormatError(
                path, f"frame {index}", f"{size} columns; the format has {COLUMNS} (duration + 43 numbers)"
            )
    try:
        frames = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        raise FormatError(path, "Frames", "holds something that is not a number") from None
    if not np.isfinite(frames).all():
        frame, column = np.argwhere(~np.isfinite(frames))[0]
        raise FormatError(path, f"frame {frame}, column {column}", f"{frames[frame, column]} is not a finite number")
    if (np.abs(frames) > LARGEST).any():
        frame, column = np.argwhere(np.abs(frames) > LARGEST)[0]
        raise FormatError(path, f"frame {frame}, column {column}", f"{frames[frame, column]:g} is no metre or radian")
    if (frames[:, 0] < 0).any():
        frame = int(np.argmax(frames[:, 0] < 0))
        raise FormatError(path, f"frame {frame}, column 0", f"duration {frames[frame, 0]} is negative")
    return loop == "wrap", frames


def _unit(path: Path, q: np.ndarray, column: int) -> np.ndarray:
    norm = np.linalg.norm(q, axis=1)
    if (norm < 1e-3).any():
        frame = int(np.argmin(norm))
        raise FormatError(path, f"frame {frame}, columns {column}-{column + 3}", "a zero quaternion is no rotation")
    w, x, y, z = (q / norm[:, None]).T
    return rotation.align(np.stack([w, x, -z, y], axis=1))  # y up to z up


def _renormed(values: np.ndarray) -> str:
    """What to say of quaternions that are not unit in the file; nothing of those that are within NORM_OFF."""
    columns, at = [3], 7
    for _, width, _ in JOINTS:
        columns += [at] if width == 4 else []
        at += width
    norms = np.stack([np.linalg.norm(values[:, at : at + 4], axis=1) for at in columns], axis=1)
    frame, worst = np.unravel_index(np.abs(norms - 1).argmax(), norms.shape)
    if abs(norms[frame, worst] - 1) < NORM_OFF:
        return ""
    place = f"frame {frame}, columns {columns[worst] + 1}-{columns[worst] + 4}"
    return f" (quaternions made unit, the furthest of norm {norms[frame, worst]:.2f} in {place})"


def _to_qpos(path: Path, body: Character, values: np.ndarray) -> np.ndarray:
    model = body.model
    qpos = np.zeros((len(values), body.nq))
    qpos[:, :3] = np.stack([values[:, 0], -values[:, 2], values[:, 1]], axis=1)
    qpos[:, 3:7] = _unit(path, values[:, 3:7], 4)
    column = 7
    for name, width, sign in JOINTS:
        joint = model.joint(name)
        at = joint.qposadr[0]
        if width == 1:
            qpos[:, at] = sign * values[:, column]
        else:
            rest = model.body_quat[joint.bodyid[0]]
            local = rotation.multiply(rotation.conjugate(rest), _unit(path, values[:, column : column + 4], column + 1))
            qpos[:, at : at + 4] = rotation.align(local)
        column += width
    return qpos


def _resample(path: Path, body: Character, qpos: np.ndarray, times: np.ndarray, fps: float) -> np.ndarray:
    if times[-1] * fps > STRETCH * len(times):
        frame = int(np.diff(times).argmax())
        raise FormatError(
            path, f"frame {frame}, column 0", f"{np.diff(times).max():g} s, where most take {1 / fps:g} s"
        )
    wanted = np.arange(int(times[-1] * fps + 1e-6) + 1) / fps
    low = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(times) - 2)
    share = np.clip((wanted - times[low]) / (times[low + 1] - times[low]), 0, 1)
    return interpolate(body, qpos[low], qpos[low + 1], share)
