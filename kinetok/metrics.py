"""Numbers that judge motion, tracking and tokens: pure numpy, arrays in, numbers out.

    mpjpe_mm(simulated, reference)                     # both (T, B, 3) metres, world frame
    apd(rollouts.reshape(M, T, -1))

SI units in; z is up. T frames, B bodies, M rollouts, F feet, N steps, S tokens per step. Nothing is aligned
or resampled here. Refuses, with ValueError, arrays of other shapes and inputs too short to define the number;
where nothing qualifies (no foot on the ground, no window in motion) the result is NaN. Knows no clip and no
simulator.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def mpjpe_mm(pos: ArrayLike, ref: ArrayLike, *, local: bool = False) -> float:
    """Mean per-joint position error in mm: 1000 * mean over t, b of |pos - ref|.

    pos, ref: (T, B, 3) in metres. In the world's frame, so that the root's drift counts (GPC, table 1; the G-MPJPE of
    Hybrid, table 2); `local` takes both from their root, the first body (there MPJPE).
    """
    pos, ref = _pair(pos, ref, "T B 3")
    if local:
        pos, ref = pos - pos[:, :1], ref - ref[:, :1]
    return float(1000.0 * np.linalg.norm(pos - ref, axis=-1).mean())


def apd(trajectories: ArrayLike) -> float:
    """Average pairwise distance of rollouts that start alike, in the unit of the trajectories.

    2 / (M (M - 1)) * sum over i < j of mean over t of |x_i(t) - x_j(t)|, with x (M, T, D) and
    M >= 2. GPC (app. C.3) gives "the mean L2 distance across all sample pairs"; the average over time is our
    reading, and D holds the root's xy (APD Root) or all bodies' xyz (APD Pose): the paper's ratio of the two
    is near sqrt(24), as distances over 24 concatenated SMPL bodies give.
    """
    x = _array(trajectories, "M T D", "trajectories")
    rollouts = len(x)
    if rollouts < 2:
        raise ValueError("trajectories holds one rollout; a pairwise distance needs at least two")
    total = sum(np.linalg.norm(x[i + 1 :] - x[i], axis=-1).mean(axis=1).sum() for i in range(rollouts - 1))
    return float(total) / (rollouts * (rollouts - 1) / 2)


def mean_acceleration(pos: ArrayLike, fps: float) -> float:
    """Mean magnitude of body acceleration in m/s^2: mean over t, b of |p(t+1) - 2 p(t) + p(t-1)| fps^2.

    pos: (T, B, 3) in metres, T >= 3 (GPC, app. C.3).
    """
    pos = _array(pos, "T B 3", "pos")
    _need_frames(pos, 3)
    return float(np.linalg.norm(np.diff(pos, 2, axis=0), axis=-1).mean() * fps**2)


def normalized_jerk(pos: ArrayLike, fps: float, window: float = 0.4, min_speed: float = 0.1) -> float:
    """Dimensionless squared jerk over sliding windows, averaged over windows and bodies.

    pos: (T, B, 3) in metres; window: D in seconds (0.4 s in GPC, app. C.3). Per window and body,

        eta = D^3 / v_peak^2 * integral over D of |d3p/dt3|^2 dt

    Hogan and Sternad 2009; of their normalisations we take peak speed (GPC does not say which). A
    minimum-jerk reach of duration D has 204.8 whatever its length and speed. The third difference stands for
    the jerk and its mean square over the window, times D, for the integral. Windows stride one frame. A body
    at rest would divide noise by zero, so windows with v_peak below `min_speed` (m/s) are left out; NaN if
    that leaves none.
    """
    pos = _array(pos, "T B 3", "pos")
    steps = round(window * fps)
    if steps < 3:
        raise ValueError(f"a window of {window} s holds {steps} steps at {fps} fps; jerk needs at least 3")
    _need_frames(pos, steps + 1)
    speed = np.linalg.norm(np.diff(pos, axis=0), axis=-1) * fps
    jerk2 = np.square(np.diff(pos, 3, axis=0)).sum(axis=-1) * fps**6
    peak = np.lib.stride_tricks.sliding_window_view(speed, steps, axis=0).max(axis=-1)
    mean2 = np.lib.stride_tricks.sliding_window_view(jerk2, steps - 2, axis=0).mean(axis=-1)
    moving = peak >= min_speed
    return float(((steps / fps) ** 4 * mean2[moving] / peak[moving] ** 2).mean()) if moving.any() else float("nan")


def utilisation(tokens: ArrayLike, vocabulary: int) -> Floats:
    """Share of the vocabulary used at each position: (S,) in [0, 1]. tokens: (N, S) ids."""
    return (_counts(tokens, vocabulary) > 0).mean(axis=1)


def perplexity(tokens: ArrayLike, vocabulary: int) -> Floats:
    """exp of the entropy of the empirical distribution at each position, (S,) in [1, vocabulary].

    exp(-sum over v of p(v) log p(v)), 0 log 0 = 0. tokens: (N, S) ids below `vocabulary`.
    """
    counts = _counts(tokens, vocabulary)
    p = counts / counts.sum(axis=1, keepdims=True)
    return np.exp(-(p * np.log(np.where(p > 0, p, 1.0))).sum(axis=1))


def foot_skate(pos: ArrayLike, height: float, fps: float) -> float:
    """Mean horizontal speed in m/s of feet on the ground: below `height` metres in both frames of a step.

    pos: (T, F, 3) in metres, T >= 2. NaN if no foot is ever on the ground.
    """
    pos = _array(pos, "T F 3", "pos")
    _need_frames(pos, 2)
    low = pos[..., 2] < height
    down = low[1:] & low[:-1]
    speed = np.linalg.norm(np.diff(pos[..., :2], axis=0), axis=-1) * fps
    return float(speed[down].mean()) if down.any() else float("nan")


def _array(value: ArrayLike, axes: str, name: str) -> Floats:
    """`value` as float64 with the named axes, of which digits fix a size; none may be empty."""
    array = np.asarray(value, dtype=np.float64)
    sizes = axes.split()
    fits = array.ndim == len(sizes) and all(
        size == int(axis) if axis.isdigit() else size > 0 for size, axis in zip(array.shape, sizes, strict=True)
    )
    if not fits:
        raise ValueError(f"{name} must be ({', '.join(sizes)}) and not empty, not {array.shape}")
    return array


def _pair(pos: ArrayLike, ref: ArrayLike, axes: str) -> tuple[Floats, Floats]:
    a, b = _array(pos, axes, "pos"), _array(ref, axes, "ref")
    if a.shape != b.shape:
        raise ValueError(f"pos is {a.shape} and ref is {b.shape}; they must be alike")
    return a, b


def _need_frames(pos: Floats, frames: int) -> None:
    if len(pos) < frames:
        raise ValueError(f"pos has {len(pos)} frames; at least {frames} are needed")


def _counts(tokens: ArrayLike, vocabulary: int) -> NDArray[np.int64]:
    """How often each id occurs at each position: (S, V)."""
    ids = np.asarray(tokens)
    if ids.ndim != 2 or ids.size == 0 or not np.issubdtype(ids.dtype, np.integer):
        raise ValueError(f"tokens must be (N, S) integers and not empty, not {ids.shape} {ids.dtype}")
    if ids.min() < 0 or ids.max() >= vocabulary:
        raise ValueError(f"tokens span {ids.min()}..{ids.max()}; the vocabulary has {vocabulary} ids")
    return np.stack([np.bincount(column, minlength=vocabulary) for column in ids.T])
