"""Where the parts of a character should be: the actor's motion in the character's proportions, feet on the ground.

    plan = make_plan(actor, figure)
    plan.places["left_foot"], plan.turns["left_foot"]         # (T, 3) m, (T, 4): joint centre, body orientation

Scale: the ratio of the leg lengths, for the path of the hips and for the ankles seen from the hips; knees follow by
the law of cosines in the actor's plane of flexion. Arms are the actor's directions with the character's lengths, from
the character's shoulders. So the targets have the character's own bones and can be reached but for joint limits.

Ground: while a foot stands it is turned level, put on z = 0, and rolls without slipping about its lowest points; what
that moves it by fades out over FADE seconds. The whole motion is raised or lowered once so that standing feet
need the least of it. `scaled` holds the targets before feet were moved.
"""

from dataclasses import dataclass

import numpy as np

from kinetok import rotation
from kinetok.motion.retarget.body import Figure
from kinetok.motion.retarget.source import SIDES, Actor, frame, stretches, to_quaternions, unit, upright
from kinetok.motion.rigs import RigError

FADE = 0.2  # s
LEVELLING = 0.1  # s, the turn into and out of a level foot
TIPTOE = 0.35  # rad
DROP = 0.08  # m, the most that the hips come down where a standing foot is out of reach
FLOOR = 30  # percentile: heights of standing feet scatter upward, since some are about to leave
SOFT = 0.004  # m: points of the sole nearer to the lowest than this share the contact


@dataclass(frozen=True, kw_only=True)
class Plan:
    """places: part -> (T, 3) joint centre; turns: part -> (T, 4) orientation of its body; scaled: part -> (T, 3) as
    places, before feet were pinned; scale: character's leg / actor's leg; ground: metres the motion was raised by."""

    places: dict[str, np.ndarray]
    turns: dict[str, np.ndarray]
    scaled: dict[str, np.ndarray]
    scale: float
    ground: float


def make_plan(actor: Actor, figure: Figure) -> Plan:
    """Targets of every part for every frame."""
    scale = leg_ratio(actor, figure)
    middle = scale * (actor.places["left_thigh"] + actor.places["right_thigh"]) / 2
    frames = {part: value for part, value in actor.frames.items() if part in figure.bodies}
    for side in SIDES:
        frames[f"{side}_foot"] = level(frames[f"{side}_foot"], ramp(actor.level[side], round(LEVELLING * actor.fps)))
    hips = {side: middle + _carried(frames["pelvis"], figure, "pelvis", f"{side}_thigh") for side in SIDES}
    ankles = {
        side: hips[side] + scale * (actor.places[f"{side}_foot"] - actor.places[f"{side}_thigh"]) for side in SIDES
    }
    ground = _ground(actor, ankles, {side: _soles(frames[f"{side}_foot"], figure, side) for side in SIDES})
    up = np.array([0, 0, ground])
    scaled, _ = _bodies(frames, figure, middle + up, {side: ankles[side] + up for side in SIDES})
    for side in SIDES:
        frames[f"{side}_foot"] = tiptoe(frames[f"{side}_foot"], figure, side, (ankles[side] + up)[:, 2], actor)
    soles = {side: _soles(frames[f"{side}_foot"], figure, side) for side in SIDES}
    pinned = {side: pin(ankles[side] + up, soles[side], actor.contact[side], actor.fps) for side in SIDES}
    down = _drop(figure, {side: hips[side] + up for side in SIDES}, pinned, actor)
    places, turned = _bodies(frames, figure, middle + up - down[:, None] * [0, 0, 1], pinned)
    turns = {part: rotation.align(to_quaternions(turned[part] @ figure.frame[part].T)) for part in turned}
    return Plan(places=places, turns=turns, scaled=scaled, scale=scale, ground=ground)


def leg_ratio(actor: Actor, figure: Figure) -> float:
    """Length of the character's legs over that of the actor's."""
    theirs = ours = 0.0
    for side in SIDES:
        for upper, lower in (("thigh", "shin"), ("shin", "foot")):
            bone = actor.places[f"{side}_{lower}"] - actor.places[f"{side}_{upper}"]
            theirs += float(np.linalg.norm(bone, axis=-1).mean())
            ours += figure.length[f"{side}_{upper}"]
    if theirs < 0.1:
        raise RigError(f"a leg of it is {theirs / 2:.3g} m long: its bones have no length")
    return ours / theirs


def _carried(frames: np.ndarray, figure: Figure, part: str, carried: str) -> np.ndarray:
    """World vectors (T, 3) from the centre of a part to that of a part fixed to it."""
    return frames @ (figure.frame[part].T @ figure.offset[carried])


def _bodies(
    frames: dict[str, np.ndarray], figure: Figure, middle: np.ndarray, ankles: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Centres and frames of all parts, from the middle of the hips and the ankles."""
    places, frames = {"pelvis": middle}, dict(frames)
    places["chest"] = middle + _carried(frames["pelvis"], figure, "pelvis", "chest")
    for side in SIDES:
        thigh, shin, foot = (f"{side}_{part}" for part in ("thigh", "shin", "foot"))
        places[thigh] = middle + _carried(frames["pelvis"], figure, "pelvis", thigh)
        axis = frames[thigh][..., 1]
        places[shin], places[foot] = bend(places[thigh], ankles[side], axis, figure.length[thigh], figure.length[shin])
        frames[thigh] = frame(places[shin] - places[thigh], axis)
        frames[shin] = frame(places[foot] - places[shin], axis)
        upper, lower, hand = (f"{side}_{part}" for part in ("upper_arm", "lower_arm", "hand"))
        places[upper] = places["chest"] + _carried(frames["chest"], figure, "chest", upper)
        places[lower] = places[upper] + figure.length[upper] * frames[upper][..., 0]
        places[hand] = places[lower] + figure.length[lower] * frames[lower][..., 0]
        frames[hand] = frames[lower]
    return places, frames


def bend(
    start: np.ndarray, end: np.ndarray, axis: np.ndarray, upper: float, lower: float
) -> tuple[np.ndarray, np.ndarray]:
    """Middle and end (T, 3) of a chain of two bones from `start` towards `end` (T, 3), flexed about axis (T, 3).

    The end is where it was asked for if the bones reach that far, else as near as they do.
    """
    towards = end - start
    distance = np.linalg.norm(towards, axis=-1, keepdims=True)
    towards = unit(towards)
    distance = np.clip(distance, abs(upper - lower) + 1e-6, upper + lower)
    cosine = np.clip((upper**2 + distance**2 - lower**2) / (2 * upper * distance), -1, 1)
    aside = unit(np.cross(towards, axis))
    middle = start + upper * (cosine * towards + np.sqrt(1 - cosine**2) * aside)
    return middle, start + distance * towards


def level(feet: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Frames (T, 3, 3) of a foot turned towards level by shares (T,)."""
    flat = upright(feet[..., 1] * [1, 1, 0], np.array([0.0, 0, 1]))
    a, b = to_quaternions(feet), to_quaternions(flat)
    return rotation.to_matrix(rotation.slerp(a, b, share))


def ramp(flags: np.ndarray, reach: int) -> np.ndarray:
    """Shares (T,): 1 where flags are set, falling smoothly to 0 over `reach` frames on either side."""
    if not flags.any():
        return np.zeros(len(flags))
    distance = np.abs(np.arange(len(flags))[:, None] - np.flatnonzero(flags)).min(1)
    return fade(distance / (reach + 1))


def fade(x: np.ndarray) -> np.ndarray:
    """1 at 0, 0 from 1 on, smooth."""
    x = np.clip(x, 0, 1)
    return 1 - x * x * (3 - 2 * x)


def _soles(feet: np.ndarray, figure: Figure, side: str) -> np.ndarray:
    """Points of the sole from the ankle, (T, K, 3) in world axes; z is that of the lowest point of the ball."""
    part = f"{side}_foot"
    corners = figure.soles[side]
    points = np.einsum("tij,kj->tki", feet @ figure.frame[part].T, corners[:, :3] - figure.centre[part])
    points[..., 2] -= corners[:, 3]
    return points


def _ground(actor: Actor, ankles: dict[str, np.ndarray], soles: dict[str, np.ndarray]) -> float:
    """How far to raise the motion so that standing feet (percentile FLOOR, of level ones if there are any) touch
    z = 0; where none stands, so that the lowest point of the feet (5th percentile) does."""
    low = {side: ankles[side][:, 2] + soles[side][..., 2].min(1) for side in SIDES}
    for flags in (actor.level, actor.contact):
        standing = np.concatenate([low[side][flags[side]] for side in SIDES])
        if len(standing):
            return -float(np.percentile(standing, FLOOR))
    return -float(np.percentile(np.minimum(*low.values()), 5))


def tiptoe(feet: np.ndarray, figure: Figure, side: str, height: np.ndarray, actor: Actor) -> np.ndarray:
    """Frames (T, 3, 3) of a foot, toes down by up to TIPTOE where it stands on them and would not reach the floor from
    an ankle at `height` (T,): a character's foot has no toe joint and is shorter than the actor's.

    In a stance that is level at times, heights count from those of its level frames, for recorded floors are not even,
    and toes go down after the first of them alone: before it, the heel comes down.
    """
    angles = np.linspace(0, TIPTOE, 15)
    turns = rotation.to_matrix(rotation.from_rotvec(np.outer(angles, [0.0, 1, 0])))
    floors = np.stack([-_soles(feet @ turn, figure, side)[..., 2].min(1) for turn in turns], axis=1)
    level, height = actor.level[side], height.copy()
    standing = actor.contact[side] & ~level
    for start, stop in stretches(actor.contact[side]):
        flat = start + np.flatnonzero(level[start:stop])
        if len(flat):
            height[start:stop] -= np.median(height[flat] - floors[flat, 0])
            standing[start : flat[0]] = False
    short = np.maximum.accumulate(floors, axis=1) < height[:, None]
    angle = angles[np.minimum(short.sum(1), len(angles) - 1)]
    angle = _spread((angle * standing)[:, None], stretches(standing), LEVELLING * actor.fps)
    return feet @ rotation.to_matrix(rotation.from_rotvec(angle * [0.0, 1, 0]))


def pin(ankles: np.ndarray, soles: np.ndarray, contact: np.ndarray, fps: float) -> np.ndarray:
    """Ankles (T, 3) moved so that feet in contact stay on z = 0 and roll without slipping, and none goes below.

    Between two frames of contact the point c of the sole that bears does not move: a' - a = c - c'.
    """
    floor = -soles[..., 2].min(1)
    shift = np.zeros_like(ankles)
    runs = stretches(contact)
    for start, stop in runs:
        weight = bearing(soles[start:stop, :, 2])
        step = -(weight[..., None] * (soles[start + 1 : stop] - soles[start : stop - 1])).sum(1)
        rolled = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
        rolled += (ankles[start:stop] - rolled).mean(0)
        shift[start:stop] = rolled - ankles[start:stop]
        shift[start:stop, 2] = floor[start:stop] - ankles[start:stop, 2]
    shift = _spread(shift, runs, FADE * fps)
    moved = ankles + shift
    moved[:, 2] = np.maximum(moved[:, 2], floor)
    return moved


def bearing(heights: np.ndarray) -> np.ndarray:
    """How much of the contact between two frames each point of a sole has: (T - 1, K) of heights (T, K), sum 1."""
    low = heights - heights.min(1, keepdims=True)
    weight = np.exp(-(low[1:] + low[:-1]) / (2 * SOFT))
    return weight / weight.sum(1, keepdims=True)


def _spread(shift: np.ndarray, runs: list[tuple[int, int]], reach: float) -> np.ndarray:
    """Shifts (T, 3), given in the runs, faded out over `reach` frames beside them."""
    spread, t = shift.copy(), np.arange(len(shift))
    for index, (start, stop) in enumerate(runs):
        before = runs[index - 1][1] if index else -np.inf
        after = runs[index + 1][0] if index + 1 < len(runs) else np.inf
        ahead = (t < start) & (t >= before)
        spread[ahead] += fade((start - t[ahead]) / min(reach, start - before + 1))[:, None] * shift[start]
        behind = (t >= stop) & (t < after)
        spread[behind] += fade((t[behind] - stop + 1) / min(reach, after - stop + 1))[:, None] * shift[stop - 1]
    return spread


def _drop(figure: Figure, hips: dict[str, np.ndarray], ankles: dict[str, np.ndarray], actor: Actor) -> np.ndarray:
    """Metres (T,) by which the hips come down so that standing feet are within reach, smooth in time."""
    need = np.zeros(len(actor.places["pelvis"]))
    for side in SIDES:
        reach = figure.length[f"{side}_thigh"] + figure.length[f"{side}_shin"]
        apart = hips[side] - ankles[side]
        room = np.sqrt(np.maximum(reach**2 - (apart[:, :2] ** 2).sum(-1), 0))
        need = np.maximum(need, (apart[:, 2] - room) * actor.contact[side])
    return envelope(np.clip(need, 0, DROP), actor.fps)


def envelope(need: np.ndarray, fps: float) -> np.ndarray:
    """A smooth curve (T,) nowhere below `need` (T,): largest value within 0.1 s, then a weighted mean as wide."""
    half = max(1, round(0.1 * fps))
    around = np.arange(-2 * half, len(need) + 2 * half)[:, None] + np.arange(-half, half + 1)
    highest = need[np.clip(around, 0, len(need) - 1)].max(1)[half:-half]
    kernel = np.hanning(2 * half + 3)[1:-1]
    return np.convolve(highest, kernel / kernel.sum(), mode="valid")
