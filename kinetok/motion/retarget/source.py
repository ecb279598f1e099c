"""A foreign motion as directions and frames of body parts, free of its rig's zero pose and joint frames.

    actor = read_actor(motion, rig, fps=30)
    actor.places["left_foot"], actor.frames["left_foot"]      # (T, 3) m, (T, 3, 3)

Two kinds of frames, whose columns are world directions:

- pelvis, chest, head and feet: ahead, left, up, as the part would have them in a body that stands facing ahead.
  A joint's rotation gives them up to a constant turn K: frame = R(t) K. If the zero pose stands upright, K is read
  off it (its arms may point anywhere); otherwise K is the mean over the motion of what the joint positions say.
  The feet's K is then corrected so that soles are level while a foot stands.
- limbs: along the bone, flexion axis, their cross product. The flexion axis of knee and elbow is along x lower bone;
  where the limb is nearly straight it is a constant of the upper bone, learned from the frames where it bends.

It knows no character.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from kinetok import rotation
from kinetok.motion.rigs import Rig
from kinetok.motion.skeleton import SkeletonMotion

SIDES = ("left", "right")
LIMBS = (("thigh", "shin", "foot"), ("upper_arm", "lower_arm", "hand"))
UPRIGHT = 0.87  # cosine of 30 degrees: a zero pose that deviates more does not stand
SNAP = 0.94  # cosine of 20 degrees: zero poses are built along the axes
BENT = (np.deg2rad(10), np.deg2rad(30))  # below the first the flexion axis is the bone's, above the second the bend's
SLOW, SHORTEST = 0.5, 0.07  # m/s, s: a foot that stands
STILL = 0.15  # m/s: the ankle of a level foot, which at push-off it rises faster than
NEAR, LOW = 0.06, 0.03  # of the leg's length: height of a joint that stands, of the ankle of a level foot that moves
TIP = np.array([0.17, 0.0, -0.07])  # of the leg's length: toes seen from the ankle
TILT = np.deg2rad(15)  # of a level foot
ANKLE = 1.3  # rad: a foot turned farther from its place below the shin was recorded wrong
LEVEL_ANGLE = np.deg2rad(40)  # a standing foot whose zero pose says more than this is no standing foot


@dataclass(frozen=True, kw_only=True)
class Actor:
    """fps; places: part -> (T, 3) m; frames: part -> (T, 3, 3); calibration: "rest" or "motion";
    contact: side -> (T,) bool, the foot stands; level: side -> (T,) bool, ankle and toe both stand."""

    fps: float
    places: dict[str, np.ndarray]
    frames: dict[str, np.ndarray]
    calibration: str
    contact: dict[str, np.ndarray]
    level: dict[str, np.ndarray]


def read_actor(motion: SkeletonMotion, rig: Rig, fps: float | None) -> Actor:
    """Frames of the parts of a motion at fps frames per second (None: its own rate)."""
    zero = _standing(motion, rig)
    stands = contacts(*_parts(motion, rig), zero, motion.fps)
    rate, motion = motion.fps, resample(motion, fps)
    at = np.minimum(np.round(np.arange(len(motion.root)) * rate / motion.fps).astype(int), len(stands[0]["left"]) - 1)
    places, turned = _parts(motion, rig)
    frames = _trunk(places, turned, zero)
    contact, level = ({side: flags[side][at] for side in SIDES} for flags in stands)
    for side in SIDES:
        for limb in LIMBS:
            frames |= _limb([f"{side}_{part}" for part in limb], places, turned, frames)
        foot = _ankled(_foot(side, places, turned, zero, level[side]), frames[f"{side}_shin"])
        frames[f"{side}_foot"] = foot
        level[side] &= foot[:, 2, 2] > np.cos(TILT)
    return Actor(
        fps=motion.fps,
        places=places,
        frames=frames,
        calibration="motion" if zero is None else "rest",
        contact=contact,
        level=level,
    )


def resample(motion: SkeletonMotion, fps: float | None) -> SkeletonMotion:
    """The same motion at another rate: slerp for rotations, linear for the root; the last frame may fall away."""
    if fps is None or fps == motion.fps:
        return motion
    if not fps > 0:
        raise ValueError(f"fps is {fps}; it must be positive, or None for the rate of the motion")
    frame = np.arange(int(motion.seconds * fps + 1e-6) + 1) / fps * motion.fps
    if len(frame) < 2:
        raise ValueError(f"motion {motion.name!r}: {motion.seconds:.3f} s give fewer than two frames at {fps} fps")
    low = np.minimum(frame.astype(int), len(motion.root) - 2)
    share = frame - low
    local = rotation.slerp(motion.local[low], motion.local[low + 1], np.repeat(share[:, None], len(motion.joints), 1))
    root = motion.root[low] + (motion.root[low + 1] - motion.root[low]) * share[:, None]
    return replace(motion, fps=float(fps), local=rotation.normalize(local), root=root)


def to_quaternions(frames: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of rotation matrices (..., 3, 3)."""
    flat = np.ascontiguousarray(frames.reshape(-1, 9), dtype=np.float64)
    q = np.empty((len(flat), 4))
    for row, matrix in zip(q, flat, strict=True):
        mujoco.mju_mat2Quat(row, matrix)
    return q.reshape(*frames.shape[:-2], 4)


def unit(v: np.ndarray) -> np.ndarray:
    """Directions (..., 3); a zero vector stays zero."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Frames (..., 3, 3) with columns `first`, `second` made perpendicular to it, and their cross product."""
    first = unit(first)
    second = unit(second - (second * first).sum(-1, keepdims=True) * first)
    return np.stack([first, second, np.cross(first, second)], axis=-1)


def upright(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Frames (..., 3, 3) with columns ahead, left, up; left is kept, up made perpendicular."""
    turned = frame(left, up)  # left, up, ahead
    return np.roll(turned, 1, axis=-1)


def _mid(places: dict[str, np.ndarray], part: str) -> np.ndarray:
    return (places[f"left_{part}"] + places[f"right_{part}"]) / 2


def _span(places: dict[str, np.ndarray], part: str) -> np.ndarray:
    return places[f"left_{part}"] - places[f"right_{part}"]


def _standing(motion: SkeletonMotion, rig: Rig) -> np.ndarray | None:
    """Frame (3, 3) in which the zero pose stands, or None if it does not (legs beside the trunk, or unlike axes)."""
    rest = np.zeros_like(motion.offsets)
    for joint, parent in enumerate(motion.parents[1:], start=1):
        rest[joint] = rest[parent] + motion.offsets[joint]
    places = {part: rest[joint] for part, joint in rig.parts.items()}
    up, left = unit(_mid(places, "upper_arm") - _mid(places, "thigh")), unit(_span(places, "thigh"))
    legs = [unit(places[f"{side}_foot"] - places[f"{side}_thigh"]) for side in SIDES]
    if max(up @ leg for leg in legs) > -UPRIGHT or abs(up @ left) > 0.5:
        return None
    return upright(_snap(left), _snap(up))


def _snap(v: np.ndarray) -> np.ndarray:
    """The coordinate axis near a direction (3,), or the direction itself where none is."""
    axis = np.eye(3)[np.abs(v).argmax()] * np.sign(v[np.abs(v).argmax()])
    return axis if axis @ v > SNAP else v


def _mean_turn(turns: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """The constant K (3, 3) for which turns (T, 3, 3) K is nearest to frames (chordal mean)."""
    u, _, v = np.linalg.svd(np.einsum("tji,tjk->ik", turns, frames))
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v


def _seen(places: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Frames (T, 3, 3) of the trunk as far as positions tell: it is straight, and the head looks ahead."""
    trunk = _mid(places, "upper_arm") - _mid(places, "thigh")
    chest = upright(_span(places, "upper_arm"), trunk)
    return {"pelvis": upright(_span(places, "thigh"), trunk), "chest": chest, "head": chest}


def _trunk(
    places: dict[str, np.ndarray], turned: dict[str, np.ndarray], zero: np.ndarray | None
) -> dict[str, np.ndarray]:
    seen = _seen(places)
    there = [part for part in seen if part in turned]
    return {part: turned[part] @ (_mean_turn(turned[part], seen[part]) if zero is None else zero) for part in there}


def _rest(
    places: dict[str, np.ndarray], turned: dict[str, np.ndarray], side: str, zero: np.ndarray | None
) -> np.ndarray:
    """A foot's K by the zero pose, or else as if on average it looked ahead and stood level below the pelvis."""
    if zero is not None:
        return zero
    return _mean_turn(turned[f"{side}_foot"], _seen(places)["pelvis"])


def _limb(
    names: list[str], places: dict[str, np.ndarray], turned: dict[str, np.ndarray], frames: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Frames of the upper and the lower bone of a limb."""
    upper, lower, end = names
    along, onward = unit(places[lower] - places[upper]), unit(places[end] - places[lower])
    # legs bend backward about the left axis, arms forward: at rest the hanging arm's axis points right
    prior = frames["pelvis"][..., 1] if "thigh" in upper else np.cross(along, frames["chest"][..., 0])
    across = np.cross(along, onward)
    local = np.einsum("tji,tj->ti", turned[upper], across).sum(0)
    local = unit(local + 0.01 * np.einsum("tji,tj->ti", turned[upper], prior).sum(0))
    bone = np.einsum("tij,j->ti", turned[upper], local)
    bend = np.arctan2(np.linalg.norm(across, axis=-1), (along * onward).sum(-1))
    share = np.clip((bend - BENT[0]) / (BENT[1] - BENT[0]), 0, 1)
    share = (share * share * (3 - 2 * share))[:, None]
    side = np.sign((across * bone).sum(-1, keepdims=True))  # overextended: the bend's axis points the other way
    side = np.where(bend[:, None] > 2 * BENT[1], 1.0, side)
    axis = share * side * unit(across) + (1 - share) * bone
    return {upper: frame(along, axis), lower: frame(onward, axis)}


def contacts(
    places: dict[str, np.ndarray], turned: dict[str, np.ndarray], zero: np.ndarray | None, fps: float
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Per side (T,) bool: the foot stands; it stands level. A joint stands when it is slow and near the lowest height
    that ankles, or toes, reach. A rig without toes gets a point where they would be."""
    size = np.mean([np.linalg.norm(places[f"{s}_foot"] - places[f"{s}_thigh"], axis=-1).max() for s in SIDES])
    tips = {}
    for side in SIDES:
        ankle = places[f"{side}_foot"]
        guess = ankle + size * (turned[f"{side}_foot"] @ _rest(places, turned, side, zero)) @ TIP
        tips[side] = places.get(f"{side}_toe", guess)
    down = {}
    for kind, points in (("ankle", {side: places[f"{side}_foot"] for side in SIDES}), ("toe", tips)):
        floor = np.percentile(np.concatenate([points[side][:, 2] for side in SIDES]), 3)
        for side in SIDES:
            rise, pace = points[side][:, 2] - floor, speed(points[side], fps)
            down[side, kind] = (pace < SLOW) & (rise < NEAR * size)
            down[side, kind, "low"] = down[side, kind] & ((rise < LOW * size) | (pace < STILL))
    shortest = max(2, round(SHORTEST * fps))
    contact = {side: _settle(down[side, "ankle"] | down[side, "toe"], shortest) for side in SIDES}
    level = {side: _settle(down[side, "ankle", "low"] & down[side, "toe"], shortest) & contact[side] for side in SIDES}
    return contact, level


def speed(points: np.ndarray, fps: float) -> np.ndarray:
    """Speeds (T,) in m/s of points (T, 3): differences over about 1/30 s."""
    half = max(1, round(fps / 60))
    t = np.arange(len(points))
    after, before = np.minimum(t + half, len(t) - 1), np.maximum(t - half, 0)
    return np.linalg.norm(points[after] - points[before], axis=-1) * fps / (after - before)


def _parts(motion: SkeletonMotion, rig: Rig) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    points, turns = motion.pose()
    places = {part: points[:, joint] for part, joint in rig.parts.items()}
    return places, {part: rotation.to_matrix(turns[:, joint]) for part, joint in rig.parts.items()}


def _settle(flags: np.ndarray, shortest: int) -> np.ndarray:
    """Close gaps of up to `shortest` frames, then drop stretches that are shorter."""
    for value in (False, True):
        for start, stop in stretches(flags == value):
            if stop - start < shortest and (value or (start > 0 and stop < len(flags))):
                flags = flags.copy()
                flags[start:stop] = not value
    return flags


def stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    """(start, stop) of every run of true values in flags (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _foot(
    side: str,
    places: dict[str, np.ndarray],
    turned: dict[str, np.ndarray],
    zero: np.ndarray | None,
    level: np.ndarray,
) -> np.ndarray:
    """Frames of a foot, level where it stands."""
    turns, toe = turned[f"{side}_foot"], f"{side}_toe"
    rest = _rest(places, turned, side, zero)
    up, ahead = rest[:, 2], rest[:, 0]
    if toe in places:
        ahead = unit(np.einsum("tji,tj->ti", turns, places[toe] - places[f"{side}_foot"]).mean(0))
    if level.sum() >= 3:
        seen = unit(np.median(np.einsum("tji,j->ti", turns[level], np.array([0.0, 0, 1])), axis=0))
        up = seen if zero is None or seen @ up > np.cos(LEVEL_ANGLE) else up
    return turns @ np.roll(frame(up, ahead), -1, axis=-1)  # up, ahead, left -> ahead, left, up


def _ankled(foot: np.ndarray, shin: np.ndarray) -> np.ndarray:
    """Frames (T, 3, 3) of a foot no farther than ANKLE from square below its shin."""
    square = np.stack([shin[..., 2], shin[..., 1], -shin[..., 0]], axis=-1)
    bend = rotation.to_rotvec(to_quaternions(square.swapaxes(-1, -2) @ foot))
    angle = np.maximum(np.linalg.norm(bend, axis=-1, keepdims=True), 1e-12)
    return square @ rotation.to_matrix(rotation.from_rotvec(bend * np.minimum(1, ANKLE / angle)))
