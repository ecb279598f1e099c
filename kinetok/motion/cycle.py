"""Find one cycle of a gait in a recording, and close it to a loop that can be repeated and varied.

    walk = cycle(clip)                             # clip: seconds of walking, recorded; walk.loop is True

Two frames are alike as far as places and velocities of all bodies agree, seen from the root's place and heading, and
the heading itself. Of every pair that lies a cycle apart the one is taken whose ends are alike most, measured by how
different the motion is in between: who stands is like himself all the time, and a jump never comes by again. Whole
multiples of a cycle are as good, so the shortest of nearly equal ones is taken. The last quarter second is then blended
to the first pose (clip.close_loop). Windowed matching of poses and velocities is what motion graphs do (Kovar, Gleicher
and Pighin 2002).
"""

from dataclasses import replace

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip, close_loop
from kinetok.motion.kinematics import kinematics

FPS = 30.0  # at which cycles are looked for
AHEAD = 0.1  # seconds: a velocity counts as the way it leads in them
TURN = 0.5  # metres that a radian of heading counts as
STILL = 0.05  # metres: who differs less from himself all the time is standing
UNLIKE = 0.35  # of how different the motion is in between, its ends may be at most
NEARLY = 1.25  # times the best: as good, if shorter
BLEND = 0.25  # seconds


def cycle(clip: Clip, *, shortest: float = 0.5, longest: float = 2.5) -> Clip:
    """The most even cycle of `shortest` to `longest` seconds in a clip (of its own body), as a loop at 30 fps or less.

    Raises ValueError where no two frames are alike enough, saying how near it came, and for a clip that is a loop.
    """
    if clip.loop:
        raise ValueError(f"clip {clip.name!r} is a loop already")
    if not 0.2 <= shortest < longest:
        raise ValueError(f"a cycle lasts at least 0.2 s, and longest is more than shortest; not {shortest}, {longest}")
    if clip.fps > FPS * 1.02:
        clip = clip.resample(FPS)
    apart = _apart(clip, min(round(longest * clip.fps), len(clip.qpos) - 1))
    first = round(shortest * clip.fps)
    if len(apart) < first:
        raise ValueError(f"clip {clip.name!r}: {clip.seconds:.2f} s hold no cycle of {shortest:g} s")
    between = np.maximum.accumulate(apart, axis=0)
    there = np.isfinite(apart) & (between > STILL)
    share = np.where(there, apart, np.inf)[first - 1 :] / np.where(there, between, 1.0)[first - 1 :]
    best = share.min(1)
    if not np.isfinite(best.min()):
        raise ValueError(f"clip {clip.name!r}: no cycle of {shortest:g} to {longest:g} s; it stands still")
    if best.min() > UNLIKE:
        raise ValueError(
            f"clip {clip.name!r}: no cycle of {shortest:g} to {longest:g} s; the two frames most alike differ by "
            f"{best.min():.0%} of what lies between ({UNLIKE:.0%} at most). Is it a gait, and longer than one cycle?"
        )
    lag = int(np.flatnonzero(best <= NEARLY * best.min())[0])
    start, frames = int(share[lag].argmin()), lag + first
    qpos = close_loop(Character.load(clip.character), clip.qpos[start : start + frames + 1], round(BLEND * clip.fps))
    ends = f"{start / clip.fps:.2f} to {(start + frames) / clip.fps:.2f} s of {clip.source or clip.name}"
    return replace(clip, qpos=qpos, loop=True, source=ends)


def _apart(clip: Clip, longest: int) -> np.ndarray:
    """How unlike each frame is to the one 1 .. `longest` later (longest, T), metres; infinite beyond the end."""
    motion = kinematics(Character.load(clip.character), clip.qpos, clip.fps)
    heading = rotation.heading(motion.xquat[:, 0])
    turn = rotation.about_z(-heading)[:, None]
    places = motion.xpos - motion.xpos[:, :1] * [1.0, 1.0, 0.0]
    seen = np.concatenate([rotation.rotate(turn, places), AHEAD * rotation.rotate(turn, motion.linear)], axis=-1)
    apart = np.full((longest, len(seen)), np.inf)
    for lag in range(1, longest + 1):
        gap = heading[lag:] - heading[:-lag]
        turned = TURN * np.arctan2(np.sin(gap), np.cos(gap))
        apart[lag - 1, : len(seen) - lag] = np.sqrt(np.square(seen[lag:] - seen[:-lag]).sum(-1).mean(1) + turned**2)
    return apart
