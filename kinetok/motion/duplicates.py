"""The same motion twice: copies under another name, excerpts, mirror images.

    for pair in duplicates(clips):
        print(clips[pair.part].name, "lies in", clips[pair.whole].name, "from", pair.start, "s")

Poses are compared without place and heading, at 30 frames per second, so another frame rate does not hide a copy; other
speeds or edits do. Measured: copies resampled to other rates differ by up to 0.008 rad a joint, DeepMimic's
stealthy_walk from its source stealthy_walk1 by 0.0002; the closest motions that are not the same by 0.09.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.check import rotations
from kinetok.motion.clip import Clip
from kinetok.motion.skeleton import SkeletonMotion

SAMPLE_HZ = 30.0
SAME = 0.03  # rad: typical difference of a joint between two copies of one motion
STILL = 0.05  # a motion whose every axis varies less has nothing to tell it by
SHORTEST = 8  # frames at SAMPLE_HZ


@dataclass(frozen=True, kw_only=True)
class Duplicate:
    """Motion `part` is found in motion `whole` (indices) from `start` seconds on, mirrored or not; error in rad."""

    part: int
    whole: int
    start: float
    mirrored: bool
    error: float


def duplicates(motions: Sequence[SkeletonMotion | Clip]) -> list[Duplicate]:
    """Pairs that hold the same motion: copies, excerpts (the shorter is `part`) and, of clips whose character can be
    mirrored, mirror images. The shorter motion's liveliest frame is looked up in the longer one, then all of it is laid
    over the best places; still poses are not compared. Time grows with the number of motions times their length.
    """
    tracks = [_features(motion) for motion in motions]
    turned = [_features(motion.mirror()) if _has_mirror(motion) else None for motion in motions]
    pairs = []
    order = sorted(range(len(tracks)), key=lambda i: len(tracks[i]))
    for at, i in enumerate(order):
        for k in order[at + 1 :]:
            if type(motions[i]) is not type(motions[k]) or tracks[i].shape[1] != tracks[k].shape[1]:
                continue
            for mirrored, track in ((False, tracks[i]), (True, turned[i])):
                if track is not None and (hit := _overlay(track, tracks[k])):
                    pairs.append(Duplicate(part=i, whole=k, start=hit[0], mirrored=mirrored, error=hit[1]))
                    break
    return sorted(pairs, key=lambda p: (p.part, p.whole))


def _has_mirror(motion: SkeletonMotion | Clip) -> TypeGuard[Clip]:
    return isinstance(motion, Clip) and "mirror" in Character.load(motion.character).roles


def _features(motion: SkeletonMotion | Clip) -> np.ndarray:
    """What the pose looks like (T', 6 J) at 30 frames per second: two axes of every joint, and of the root the
    direction of gravity twice, so that place and heading do not count."""
    q = rotations(motion)[1]
    axes = rotation.to_matrix(q)[..., :2]
    down = rotation.to_matrix(q[:, 0])[:, 2]
    axes[:, 0] = np.stack([down, down], axis=-1)
    flat = axes.reshape(len(q), -1)
    times = np.arange(int(motion.seconds * SAMPLE_HZ + 1e-6) + 1) * motion.fps / SAMPLE_HZ
    return _linear(flat, times)


def _linear(values: np.ndarray, frames: np.ndarray) -> np.ndarray:
    low = np.clip(frames.astype(int), 0, max(len(values) - 2, 0))
    high = np.minimum(low + 1, len(values) - 1)
    return values[low] + (values[high] - values[low]) * (frames - low)[:, None]


def _overlay(part: np.ndarray, whole: np.ndarray) -> tuple[float, float] | None:
    """Where `part` lies in `whole`: its start in seconds and the typical difference in rad, or None."""
    joints = part.shape[1] / 6
    if len(part) < SHORTEST or part.std(0).max() < STILL:
        return None
    key = int(np.linalg.norm(np.diff(part, axis=0), axis=1).argmax())
    reach = np.arange(key, len(whole) - (len(part) - key) + 2)
    reach = reach[(reach < len(whole)) & (reach >= key)]
    if not len(reach):
        return None
    apart = np.linalg.norm(whole[reach] - part[key], axis=1) / math.sqrt(2 * joints)
    best = None
    for at in reach[np.argsort(apart)[:8]]:
        for shift in np.linspace(-1, 1, 9):
            start = max(at - key + shift, 0.0)
            frames = start + np.arange(len(part))
            frames = frames[frames <= len(whole) - 1 + 1e-9]
            gap = np.linalg.norm(_linear(whole, frames) - part[: len(frames)], axis=1) / math.sqrt(2 * joints)
            error = float(np.median(gap))
            if len(frames) >= len(part) - 2 and error < SAME and (best is None or error < best[1]):
                best = (float(start) / SAMPLE_HZ, error)
    return best
