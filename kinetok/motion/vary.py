"""Variations of a gait: turn where it went straight, hurry, linger, halt and go on, go over into another gait.

    clip = vary(walk, seconds=60, turn=60, tempo=1.2, halt=6, seed=0)      # one long motion, no longer a loop
    clip = vary(walk, into=jog, seconds=60, turn=60)                       # from walking to jogging and back
    clip = vary(walk, into=standing(walk), seconds=60, turn=60)            # to a stand and back, by smaller steps

A recorded walk cycle goes one way at one speed; a prior that saw no other has nothing to choose from. Four changes
keep a motion near to what a body can do, and physics does the rest when it is tracked:

- turn     the path is bent by a yaw rate that wanders, the less the faster it goes (SIDEWAYS); the body leans into it
           by atan(v * rate / g) about its feet
- tempo    the motion plays faster and slower by a factor that wanders
- halt     it comes to rest where both feet are on the floor and hardly move, stays a while, and goes on
- into     its cycle is blended with another's, in step (Rose, Cohen, Bodenheimer 1998, "Verbs and adverbs"), by a share
           that wanders: between a walk and a jog lie all the speeds that neither has, between a walk and standing all
           slower ones, in steps that grow as small, and turns that do

Nothing here simulates: the result is a reference, to be tracked like any other. Where the feet stand, a bent path drags
them along an arc; a simulated body does not follow that, and its tracking error is larger for it.
"""

from dataclasses import replace

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip, interpolate
from kinetok.motion.kinematics import kinematics, lowest_point

VARIED = "-varied"
FPS = 60.0
WANDER = 1.5  # seconds from one random value of turn or tempo to the next
CHANGE = 3.0  # seconds from one share of another gait to the next, unless told
SHORTEST = 0.5  # of these: less is a stumble
SIDEWAYS = 2.2  # m/s^2 towards the inside of a turn at most, the pace of a jog that turns by 45 degrees/s
RAMP = 0.5  # seconds to stop or to start
STAY = (0.5, 2.5)  # seconds a halt lasts
QUIET = 0.7  # m/s: the fastest foot of a moment at which a body can halt
DWELL = 0.8  # above 0.5 a blend stays in either gait for a while
GRAVITY = 9.81


def vary(
    clip: Clip,
    *,
    seconds: float = 60.0,
    turn: float = 60.0,
    tempo: float = 1.2,
    halt: float = 0.0,
    into: Clip | None = None,
    change: float = CHANGE,
    seed: int = 0,
) -> Clip:
    """A motion of `seconds` made of a clip that begins and ends alike, or of as much of another one as there is.

    turn: degrees per second the path turns at most, to either side. tempo: it plays so many times as fast or slow at
    most. halt: seconds of moving between two halts on average; 0 for none. into: a gait, of one left and one right step
    like `clip` itself, that it goes over into and back; change: seconds from one share of it to the next. The same
    seed gives the same motion.
    Raises ValueError for a motion that has no moment to halt at, naming its fastest foot.
    """
    if not (seconds > 0 and turn >= 0 and tempo >= 1 and halt >= 0 and change >= SHORTEST):
        raise ValueError(
            f"clip {clip.name!r}: seconds must be above 0, turn and halt not below 0, tempo at least 1, change "
            f"at least {SHORTEST}; not {seconds}, {turn}, {halt}, {tempo}, {change}"
        )
    if into is not None and (halt or not (clip.loop and into.loop) or clip.character != into.character):
        raise ValueError(
            f"{clip.name!r} into {into.name!r}: both must be loops of one character, and halt 0; they are of "
            f"{clip.character!r} and {into.character!r}, loop {clip.loop} and {into.loop}, halt {halt:g}"
        )
    rng, steps = np.random.default_rng(seed), round(seconds * FPS)
    bent, speed = _wander(rng, steps) * np.radians(turn), tempo ** _wander(rng, steps)
    source = f"varied by turn {turn:g} deg/s, tempo {tempo:g}, halt {halt:g} s, seed {seed}"
    if into is not None:
        share = (0.5 + DWELL * _wander(rng, steps, change)).clip(0, 1)
        qpos, name = _blend(clip, into, share, speed), f"{clip.name}-{into.name}{VARIED}"
        stands = np.ptp(into.qpos[:, :2]) < 1e-6
        qpos = _bend(qpos, bent * speed * (1 - share if stands else 1))  # who stands does not turn
        if stands:
            qpos[:, 2] -= np.minimum(lowest_point(Character.load(clip.character), qpos), 0)  # knees in step bend less
        source = f"{clip.source} into {into.source} within {change:g} s, {source}"
        return replace(clip, name=name, fps=FPS, qpos=qpos, loop=False, source=source)
    phase = _play(speed, _quiet(clip) if halt else np.empty(0), halt, rng, clip)
    if not clip.loop:
        phase = phase[: np.searchsorted(phase, clip.seconds)]
        if len(phase) < 2:
            raise ValueError(f"clip {clip.name!r}: {clip.seconds:.2f} s are too short to vary")
    qpos = clip.at(phase)
    rate = np.diff(phase, append=2 * phase[-1] - phase[-2]) * FPS
    return replace(
        clip, name=clip.name + VARIED, fps=FPS, qpos=_bend(qpos, bent[: len(qpos)] * rate), loop=False,
        source=f"{clip.source}, {source}",
    )  # fmt: skip


def standing(clip: Clip) -> Clip:
    """The character's standing pose for a cycle of `clip`, facing as it does: a gait of no way to go over into."""
    qpos = np.tile(Character.load(clip.character).stand(), (2, 1))
    qpos[:, 3:7] = rotation.about_z(np.repeat(rotation.heading(clip.qpos[:1, 3:7]), 2))
    return replace(clip, name="stand", fps=1 / clip.seconds, qpos=qpos, loop=True, source="the standing pose")


def _wander(rng: np.random.Generator, steps: int, seconds: float = WANDER) -> np.ndarray:
    """A smooth random signal (steps,) within [-1, 1]: cosines from one random value to the next, `seconds` later."""
    every = round(seconds * FPS)
    knots = rng.uniform(-1, 1, steps // every + 2)
    index, share = np.divmod(np.arange(steps), every)
    share = (1 - np.cos(np.pi * share / every)) / 2
    return knots[index] + (knots[index + 1] - knots[index]) * share


def _quiet(clip: Clip) -> np.ndarray:
    """Times (K,) within the clip at which its fastest foot is slowest, where that is slow enough to halt."""
    body = Character.load(clip.character)
    times = np.arange(0, clip.seconds, 1 / FPS)
    motion = kinematics(body, clip.at(times), FPS)
    fastest = np.linalg.norm(motion.linear[:, body.bodies("feet")], axis=-1).max(1)
    before, after = np.roll(fastest, 1), np.roll(fastest, -1)
    found = times[(fastest <= before) & (fastest < after) & (fastest < QUIET)]
    if not len(found):
        raise ValueError(
            f"clip {clip.name!r} has no moment to halt at: its fastest foot never moves slower than "
            f"{fastest.min():.2f} m/s ({QUIET} is asked for); leave halt at 0"
        )
    return found


def _play(speed: np.ndarray, quiet: np.ndarray, halt: float, rng: np.random.Generator, clip: Clip) -> np.ndarray:
    """The clip's time at every step, played at speed (T,), and at rest now and then at one of the quiet times."""
    phase, rates = np.zeros(len(speed)), []
    wait = rng.exponential(halt) if halt else np.inf
    for t in range(1, len(speed)):
        rate = speed[t]
        if not rates and wait <= 0:
            ahead = (quiet - phase[t - 1]) % clip.seconds if clip.loop else quiet - phase[t - 1]
            near = ahead[(ahead > 0.3 * rate * RAMP) & (ahead <= 0.5 * rate * RAMP)]
            if len(near):
                rates, wait = _rest(near.min(), rate, rng), rng.exponential(halt)
        elif not rates:
            wait -= 1 / FPS
        phase[t] = phase[t - 1] + (rates.pop(0) if rates else rate) / FPS
    return phase


def _rest(distance: float, rate: float, rng: np.random.Generator) -> list[float]:
    """Rates of a stop within `distance` seconds of the clip, of a stay and of a start."""
    down = max(round(2 * distance / rate * FPS), 1)
    slowing = rate * (1 + np.cos(np.pi * (np.arange(down) + 0.5) / down)) / 2
    still, up = np.zeros(round(rng.uniform(*STAY) * FPS)), round(RAMP * FPS)
    starting = rate * (1 - np.cos(np.pi * (np.arange(up) + 0.5) / up)) / 2
    return [*slowing, *still, *starting]


def _blend(clip: Clip, into: Clip, share: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Poses (T, nq) with a share (T,) of `into`, in step: both cycles are counted from where the left foot leads most.

    Cycles per second are blended as the poses are, and times speed (T,); so is the way of each step.
    """
    rate = speed / (clip.seconds + share * (into.seconds - clip.seconds))
    cycles = np.concatenate([[0.0], np.cumsum(rate[:-1])]) / FPS
    a, b = (gait.at((cycles + _leads(gait)) * gait.seconds) for gait in (clip, into))
    qpos = interpolate(Character.load(clip.character), a, b, share)
    way = np.diff(a[:, :2], axis=0) * (1 - share[:-1, None]) + np.diff(b[:, :2], axis=0) * share[:-1, None]
    qpos[:, :2] = a[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(way, axis=0)])
    return qpos


def _leads(clip: Clip) -> float:
    """The share of the cycle after which the character's second foot is furthest ahead of its first one."""
    body = Character.load(clip.character)
    times = np.arange(0, clip.seconds, 1 / FPS)
    qpos = clip.at(times)
    first, second = (kinematics(body, qpos, FPS).xpos[:, foot] for foot in body.bodies("feet")[:2])
    heading = rotation.heading(qpos[:, 3:7])
    ahead = ((second - first)[:, :2] * np.stack([np.cos(heading), np.sin(heading)], axis=1)).sum(1)
    return float(times[ahead.argmax()] / clip.seconds)


def _bend(qpos: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Poses (T, nq) whose path turns by rate (T,) radians per second more than it did, leaning into the turn.

    Where that would take more than SIDEWAYS, it turns by less.
    """
    step = np.diff(qpos[:, :2], axis=0)
    speed = _smooth(np.linalg.norm(step, axis=1) * FPS)[: len(qpos)]
    rate = rate.clip(-SIDEWAYS / speed.clip(1e-6), SIDEWAYS / speed.clip(1e-6))
    angle = np.concatenate([[0.0], np.cumsum(rate[:-1])]) / FPS
    half = (angle[1:] + angle[:-1]) / 2
    cos, sin = np.cos(half), np.sin(half)
    path = np.stack([cos * step[:, 0] - sin * step[:, 1], sin * step[:, 0] + cos * step[:, 1]], axis=1)
    out = qpos.copy()
    out[1:, :2] = qpos[0, :2] + np.cumsum(path, axis=0)
    # Lean about the point on the floor below the root, towards the centre of the turn, by the path's own mean speed.
    lean = np.arctan(speed * rate / GRAVITY)
    along = rotation.heading(qpos[:, 3:7]) + angle
    axis = np.stack([np.cos(along), np.sin(along), np.zeros_like(along)], axis=1)
    tilt = rotation.from_rotvec(-lean[:, None] * axis)
    above = np.zeros((len(qpos), 3))
    above[:, 2] = qpos[:, 2]
    out[:, 3:7] = rotation.multiply(tilt, rotation.multiply(rotation.about_z(angle), qpos[:, 3:7]))
    out[:, :3] = np.concatenate([out[:, :2], np.zeros((len(qpos), 1))], axis=1) + rotation.rotate(tilt, above)
    return out


def _smooth(speed: np.ndarray) -> np.ndarray:
    """Means (T + 1,) of speed (T,) over about a second, of which one more fit in than there were steps."""
    window = min(round(FPS), len(speed))
    padded = np.pad(speed, (window // 2, window - window // 2), mode="edge")
    return np.convolve(padded, np.ones(window) / window, "valid")
