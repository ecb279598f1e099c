"""The gate for recorded motion: what is wrong with it, what of that has one right fix, and where the rest stands.

    clip, findings = mend(clip)                     # fixes what has one right fix and says so
    print(report(check(motion)))                    # the same findings, nothing changed

It takes a SkeletonMotion (as recorded) or a Clip (on a character). A finding is "fixed" (mend repairs it; it is
gone afterwards), "refused" (wrong, and more than one repair is thinkable: cut the motion or leave it out) or a
"note" (odd, usable). Frames are counted in the motion as given, also after a lead-in was dropped.

Thresholds, and the recordings they were measured on (CMU in five conversions, SNU, DeepMimic, two robot sets):
- jump: one step above 25 rad/s and twice both steps beside it. Dirty frames found: toes of the MotionBuilder
  conversion 32 and 42, robot shoulders 27 and 36, an arm in FAIR1's dab 34. Honest fast motion does not stand out from
  its neighbours: the backflip's shoulder at 30 is 1.7 times its neighbour, a kick's knee and ankle at 25 once.
- jumps and fast stretches of less than 0.55 rad are notes: the walk that the packaged tracker follows at 100 % has a
  step of 0.50 rad in a shoulder, and the toes of optical recordings flicker by 0.2 to 0.4 (CMU 01_01, 11_01, 12_01).
- fast: above 45 rad/s, the elbow of a baseball pitch (2,500 degrees/s). Found: a shoulder turning about itself at
  54 for eight frames (Daz conversion of 05_03), a toe at 63 (SNU kick).
- spike: out and back by 0.2 rad and 12 rad/s, landing within a third of that, with calm steps on both sides.
- root: 12.5 m/s is the fastest a person has run.
- lead-in: the first step above 30 rad/s out of a near-rest pose: 47 to 101 and decaying over five steps (Daz),
  173 and 285 in one step (MotionBuilder).
- floor of a clip: 25 mm, in every second of it; DeepMimic's clips stay within, two generated robot walks stand 29 and
  32 mm under it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import mujoco
import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import kinematics, lowest_point
from kinetok.motion.skeleton import SkeletonMotion

JUMP, JUMP_RATIO, JUMP_SMALL = 25.0, 2.0, 0.55  # rad/s, times the faster neighbour, rad
FAST = 45.0  # rad/s
SPIKE_ANGLE, SPIKE_SPEED, SPIKE_CALM = 0.2, 12.0, 1 / 3  # rad, rad/s, share of the step
LIMIT = 0.05  # rad beyond a hinge's range; generated robot motion passes it by 0.02
ROOT_FAST = 12.5  # m/s
LEAD_SPEED, LEAD_REST, LEAD_FRAMES = 30.0, 0.1, 8  # rad/s, median rad from rest, frames
FROZEN_SECONDS = 0.25
SIZE = (0.5, 2.6)  # metres: the rest pose of a body, joints only
HUMAN = (1.4, 2.1)  # the same for an adult
UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048, "CMU units": 0.0564}
FLOOR, FLOOR_SPREAD, FLOOR_DEEP, FLOOR_WRONG = 0.025, 0.06, 0.15, 0.3  # metres
WINDOW_SECONDS = 1.0

Severity = Literal["fixed", "refused", "note"]
M = TypeVar("M", SkeletonMotion, Clip, SkeletonMotion | Clip)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """kind: "spike", "floor", ...; severity; frame and joint where it is, None for the whole motion; value: the
    measured number; message: what is wrong and what was or can be done."""

    kind: str
    severity: Severity
    frame: int | None = None
    joint: str | None = None
    value: float | None = None
    message: str


def check(motion: SkeletonMotion | Clip) -> list[Finding]:
    """All findings; those called "fixed" are what `mend` would repair."""
    return mend(motion)[1]


def mend(motion: M) -> tuple[M, list[Finding]]:
    """The motion with everything repaired that has one right repair, and all findings."""
    found: list[Finding] = []
    motion, signs = _align_signs(motion)
    found += signs
    motion, lead = _drop_lead_in(motion)
    dropped = int(lead[0].value or 0) if lead else 0
    found += lead
    for repair in (_mend_spikes, _mend_units):
        motion, more = repair(motion)
        found += _shifted(more, dropped)
    found += _shifted([*_jumps(motion), *_root_jumps(motion), *_frozen(motion), *_beyond_limits(motion)], dropped)
    wrong_way = _up_axis(motion)
    found += wrong_way
    if not any(f.severity == "refused" and f.kind in ("up", "units") for f in found):
        motion, more = _mend_floor(motion)
        found += _shifted(more, dropped)
    return motion, found


def report(findings: Sequence[Finding]) -> str:
    """A line for each kind of finding and joint, its worst frame and where else, refusals first; then the counts."""
    order: tuple[Severity, ...] = ("refused", "fixed", "note")
    alike: dict[tuple, list[Finding]] = {}
    for f in sorted(findings, key=lambda f: order.index(f.severity)):
        alike.setdefault((f.severity, f.kind, f.joint), []).append(f)
    lines = []
    for (severity, kind, joint), group in alike.items():
        worst = max(group, key=lambda f: abs(f.value or 0))
        others = sorted({f.frame for f in group if f.frame is not None} - {worst.frame})
        more = f" (also at {', '.join(map(str, others[:8]))}{', ...' * (len(others) > 8)})" if others else ""
        place = [f"frame {worst.frame}"] * (worst.frame is not None) + [f"joint {joint}"] * (joint is not None)
        lines.append(f"{severity:<8}{kind:<9}{', '.join(place)}{': ' * bool(place)}{worst.message}{more}")
    counts = [sum(f.severity == severity for f in findings) for severity in order]
    summary = ", ".join(f"{n} {s}{'s' * (s == 'note' and n > 1)}" for n, s in zip(counts, order, strict=True) if n)
    return "\n".join([*lines, summary or "nothing to say: the motion is clean"])


def _finding(kind: str, severity: Severity, message: str, *, frame=None, joint=None, value=None) -> Finding:
    frame, value = None if frame is None else int(frame), None if value is None else float(value)
    return Finding(kind=kind, severity=severity, frame=frame, joint=joint, value=value, message=message)


def _shifted(findings: Sequence[Finding], frames: int) -> list[Finding]:
    return [f if f.frame is None else replace(f, frame=f.frame + frames) for f in findings]


def _runs(mask: np.ndarray) -> Iterator[tuple[int, int]]:
    """First and last index of every stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    yield from ((int(a), int(b) - 1) for a, b in edges.reshape(-1, 2))


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return rotation.slerp(a, b, np.array(0.5))


def _columns(body: Character) -> list[tuple[str, int, int]]:
    """Name, first qpos column and width of the root's rotation and of every ball joint and hinge."""
    model, kinds = body.model, mujoco.mjtJoint
    widths = {kinds.mjJNT_FREE: 4, kinds.mjJNT_BALL: 4, kinds.mjJNT_HINGE: 1}
    return [
        (
            model.joint(j).name or model.body(model.jnt_bodyid[j]).name,
            int(model.jnt_qposadr[j]) + 3 * (kind == kinds.mjJNT_FREE),
            widths[kind],
        )
        for j, kind in enumerate(map(kinds, model.jnt_type))
        if kind in widths
    ]


def rotations(motion: SkeletonMotion | Clip) -> tuple[list[str], np.ndarray]:
    """Joint names and rotations (T, J, 4); the angle of a hinge is a turn about x."""
    if isinstance(motion, SkeletonMotion):
        return list(motion.joints), motion.local
    columns = _columns(Character.load(motion.character))
    parts = []
    for _, at, width in columns:
        angle = motion.qpos[:, at, None] * np.array([1.0, 0.0, 0.0])
        parts.append(motion.qpos[:, at : at + 4] if width == 4 else rotation.from_rotvec(angle))
    return [name for name, _, _ in columns], np.stack(parts, axis=1)


def _root(motion: SkeletonMotion | Clip) -> np.ndarray:
    return motion.root if isinstance(motion, SkeletonMotion) else motion.qpos[:, :3]


def _positions(motion: SkeletonMotion | Clip, limit: int = 512) -> np.ndarray:
    """World positions (T', B, 3) of joints or bodies in at most `limit` frames spread over the motion."""
    every = max(1, math.ceil(len(_root(motion)) / limit))
    if isinstance(motion, SkeletonMotion):
        return motion.pose()[0][::every]
    return kinematics(Character.load(motion.character), motion.qpos[::every], motion.fps / every).xpos


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(rotation.to_rotvec(rotation.multiply(rotation.conjugate(a), b)), axis=-1)


def _steps(motion: SkeletonMotion | Clip) -> tuple[list[str], np.ndarray]:
    """Joint names and angles (T - 1, J) from each frame to the next, radians."""
    names, q = rotations(motion)
    return names, _angles(q[:-1], q[1:])


def _align_signs(motion: M) -> tuple[M, list[Finding]]:
    """Neighbouring quaternions into one hemisphere; hinge angles without turns of 2 pi."""
    found = []
    if isinstance(motion, SkeletonMotion):
        aligned = rotation.align(motion.local)
        flips = (aligned * motion.local).sum(-1) < 0
        names, fixed = motion.joints, replace(motion, local=aligned)
    else:
        columns = _columns(Character.load(motion.character))
        qpos, names = motion.qpos.copy(), [name for name, _, _ in columns]
        for _, at, width in columns:
            part = qpos[:, at : at + width]
            qpos[:, at : at + width] = rotation.align(part) if width == 4 else np.unwrap(part, axis=0)
        moved = [np.abs(qpos[:, at : at + w] - motion.qpos[:, at : at + w]).max(1) > 1e-6 for _, at, w in columns]
        flips, fixed = np.stack(moved, axis=1), replace(motion, qpos=qpos)
    for j in np.flatnonzero(flips.any(0)):
        count = int(np.abs(np.diff(flips[:, j].astype(int))).sum())
        message = f"{count} sign flips or full turns between frames, aligned; the rotations are the same"
        found.append(
            _finding("sign", "fixed", message, frame=int(flips[:, j].argmax()), joint=names[j], value=float(count))
        )
    return (fixed if found else motion), found


def _drop_lead_in(motion: M) -> tuple[M, list[Finding]]:
    """Without the rest pose that some converters put before the motion, and the frames that blend out of it."""
    names, steps = _steps(motion)
    speed = steps.max(1) * motion.fps
    held = int(np.argmax(speed > 1e-3 * motion.fps)) if (speed > 1e-3 * motion.fps).any() else 0
    rest = np.median(np.linalg.norm(rotation.to_rotvec(rotations(motion)[1][0, 1:]), axis=-1)) if len(names) > 1 else 9
    if rest > LEAD_REST:
        return motion, []
    slow = "begins in the skeleton's rest pose, left slowly: cut that off if it is no part of the motion"
    noted = [_finding("lead-in", "note", slow, frame=0)] if isinstance(motion, SkeletonMotion) else []
    if speed[held] < LEAD_SPEED or len(speed) < held + LEAD_FRAMES + 2:
        return motion, noted
    last = held  # the last step of the blend: the next one is no longer clearly slower
    while last < held + LEAD_FRAMES and (speed[last] > LEAD_SPEED or speed[last + 1] < 0.7 * speed[last]):
        last += 1
    if last == held + LEAD_FRAMES:
        return motion, []  # it never calms down: no lead-in, `_jumps` will judge
    # A blend's last frame still carries a trace of the rest pose.
    first = last + 1 if last > held + 1 else last
    message = f"rest pose at the beginning, left at {speed[held]:.0f} rad/s: {first} frame{'s' * (first > 1)} dropped"
    joint = names[int(steps[held].argmax())]
    return _cut(motion, first), [_finding("lead-in", "fixed", message, frame=0, joint=joint, value=first)]


def _cut(motion: M, first: int) -> M:
    if isinstance(motion, SkeletonMotion):
        return replace(motion, local=motion.local[first:], root=motion.root[first:])
    return replace(motion, qpos=motion.qpos[first:], loop=False)


def _mend_spikes(motion: M) -> tuple[M, list[Finding]]:
    """A lone frame in which one joint leaves and comes back lies between its neighbours afterwards."""
    names, q = rotations(motion)
    angles = _angles(q[:-1], q[1:])
    if len(angles) < 4:
        return motion, []
    step = np.minimum(angles[:-1], angles[1:])  # in and out of frames 1 .. T - 2
    back = _angles(q[:-2], q[2:])
    calm = np.full_like(step, -np.inf)
    calm[1:] = angles[:-2]
    calm[:-1] = np.maximum(calm[:-1], angles[2:])
    lone = (step > SPIKE_ANGLE) & (step * motion.fps > SPIKE_SPEED)
    lone &= (back < SPIKE_CALM * step) & (calm < SPIKE_CALM * step)
    found, values = [], motion.local.copy() if isinstance(motion, SkeletonMotion) else motion.qpos.copy()
    columns = [] if isinstance(motion, SkeletonMotion) else _columns(Character.load(motion.character))
    for frame, j in np.argwhere(lone):
        t = int(frame) + 1
        if isinstance(motion, SkeletonMotion):
            values[t, j] = _between(values[t - 1, j], values[t + 1, j])
        else:
            _, at, width = columns[j]
            a, b = values[t - 1, at : at + width], values[t + 1, at : at + width]
            values[t, at : at + width] = _between(a, b) if width == 4 else (a + b) / 2
        message = f"left by {step[frame, j]:.2f} rad for one frame and returned; laid between its neighbours"
        found.append(_finding("spike", "fixed", message, frame=t, joint=names[j], value=step[frame, j] * motion.fps))
    if not found:
        return motion, []
    if isinstance(motion, SkeletonMotion):
        return replace(motion, local=values), found
    return replace(motion, qpos=values), found


def _jumps(motion: SkeletonMotion | Clip) -> list[Finding]:
    """Steps that stand out from their neighbours, and joints faster than any body's: the worst frame of each."""
    names, angles = _steps(motion)
    speed = angles * motion.fps
    beside = np.zeros_like(speed)
    beside[1:] = speed[:-1]
    beside[:-1] = np.maximum(beside[:-1], speed[1:])
    found = []
    for j, name in enumerate(names):
        jump = (speed[:, j] > JUMP) & (speed[:, j] > JUMP_RATIO * beside[:, j])
        for t in np.flatnonzero(jump):
            severity, remedy = _verdict(angles[t, j])
            message = f"turns {angles[t, j]:.2f} rad in one step ({speed[t, j]:.0f} rad/s) and stays; {remedy}"
            found.append(_finding("jump", severity, message, frame=t + 1, joint=name, value=speed[t, j]))
        for first, last in _runs((speed[:, j] > FAST) & ~jump):
            t = first + int(speed[first : last + 1, j].argmax())
            severity, remedy = _verdict(angles[first : last + 1, j].sum())
            message = f"{speed[t, j]:.0f} rad/s, over {FAST:.0f} in frames {first} to {last + 1}; {remedy}"
            found.append(_finding("fast", severity, message, frame=t + 1, joint=name, value=speed[t, j]))
    return found


def _verdict(angle: float) -> tuple[Severity, str]:
    return ("note", "small enough to follow") if angle < JUMP_SMALL else ("refused", "cut it there or leave it out")


def _root_jumps(motion: SkeletonMotion | Clip) -> list[Finding]:
    speed = np.linalg.norm(np.diff(_root(motion), axis=0), axis=1) * motion.fps
    found = []
    for first, last in _runs(speed > ROOT_FAST):
        t = first + int(speed[first : last + 1].argmax())
        message = f"the root moves at {speed[t]:.1f} m/s (frames {first} to {last + 1}); no one runs faster than 12.5"
        found.append(_finding("jump", "refused", message, frame=t + 1, joint="root position", value=speed[t]))
    return found


def _frozen(motion: SkeletonMotion | Clip) -> list[Finding]:
    """Stretches in which nothing at all changes, to the last bit, in a motion that otherwise moves."""
    parts = (motion.qpos,) if isinstance(motion, Clip) else (motion.root, motion.local.reshape(len(motion.root), -1))
    same = np.all([(np.diff(part, axis=0) == 0).all(1) for part in parts], axis=0)
    found = []
    for first, last in _runs(same):
        seconds = (last - first + 1) / motion.fps
        if seconds >= FROZEN_SECONDS:
            message = f"nothing changes from frame {first} to {last + 1} ({seconds:.2f} s): the recording stood still"
            found.append(_finding("frozen", "note", message, frame=first, value=seconds))
    return found


def _beyond_limits(motion: SkeletonMotion | Clip) -> list[Finding]:
    """Hinges of a clip that are bent further than their character's: the worst frame of each."""
    if isinstance(motion, SkeletonMotion):
        return []
    model, found = Character.load(motion.character).model, []
    for j in np.flatnonzero((model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & model.jnt_limited.astype(bool)):
        (low, high), angle = model.jnt_range[j], motion.qpos[:, model.jnt_qposadr[j]]
        beyond = np.maximum(low - angle, angle - high)
        t = int(beyond.argmax())
        if beyond[t] > LIMIT:
            severity, remedy = _verdict(beyond[t])
            message = (
                f"at {angle[t]:+.2f} rad, {beyond[t]:.2f} beyond its range of {low:+.2f} to {high:+.2f}, and so in "
                f"{np.mean(beyond > LIMIT):.0%} of the frames; {remedy}"
            )
            found.append(_finding("limit", severity, message, frame=t, joint=model.joint(j).name, value=beyond[t]))
    return found


def _rest_size(motion: SkeletonMotion | Clip) -> float:
    """Largest extent of the body in its rest pose, joints or bodies only, metres."""
    if isinstance(motion, SkeletonMotion):
        places = np.zeros_like(motion.offsets)
        for j, parent in enumerate(motion.parents):
            places[j] = places[parent] + motion.offsets[j] if parent >= 0 else 0
    else:
        body = Character.load(motion.character)
        places = kinematics(body, np.stack([body.model.qpos0] * 2), 1.0).xpos[0]
    return float(np.ptp(places, axis=0).max())


def _mend_units(motion: M) -> tuple[M, list[Finding]]:
    """A skeleton in metres, if exactly one unit makes it the size of a person."""
    size = _rest_size(motion)
    if isinstance(motion, SkeletonMotion) and not SIZE[0] <= size <= SIZE[1]:
        scales = {f"{name} taken for metres": s for name, s in UNITS.items()}
        scales |= {f"metres taken for {name}": 1 / s for name, s in UNITS.items()}
        fits = {name: s for name, s in scales.items() if HUMAN[0] <= size * s <= HUMAN[1]}
        if len(fits) == 1:
            (name, scale), unit = fits.popitem(), motion.unit
            message = f"the body is {size:.3g} m large: {name}; scaled by {scale:.4g} to {size * scale:.2f} m"
            fixed = replace(motion, offsets=motion.offsets * scale, root=motion.root * scale, unit=f"{unit}, {name}")
            return fixed, [_finding("units", "fixed", message, value=size)]
        span = f"a person's joints span {HUMAN[0]} to {HUMAN[1]} m"
        message = f"the body is {size:.3g} m large; {span}: name the unit (BVH: --unit)"
        return motion, [_finding("units", "refused", message, value=size)]
    height = float(np.median(np.abs(_root(motion)[:, 2])))
    if height > 10 * size:
        message = f"the root is {height:.1f} m high on a body of {size:.2f} m: its position is in another unit"
        return motion, [_finding("units", "refused", message, joint="root position", value=height)]
    return motion, []


def _up_axis(motion: SkeletonMotion | Clip) -> list[Finding]:
    """A body that stands along x or y on a floor of that axis, or on its head, from beginning to end."""
    places = _positions(motion)
    extent, low = np.median(np.ptp(places, axis=1), axis=0), places.min(1)
    for axis, letter in ((0, "x"), (1, "y")):
        longest = extent[axis] > 1.5 * extent[2]
        floor = (
            np.mean(np.abs(low[:, axis] - np.median(low[:, axis])) < 0.15) > 0.9 and abs(np.median(low[:, axis])) < 0.25
        )
        if longest and floor and not np.mean(np.abs(low[:, 2]) < 0.1) > 0.9:
            message = (
                f"the body stands along {letter} all the time, on a floor of that axis: {letter} is up in the file"
            )
            return [_finding("up", "refused", message, value=extent[axis])]
    head, feet = _named(motion)
    if head and feet:
        rise = places[:, head, 2].mean(1) - places[:, feet, 2].mean(1)
        if (rise < -0.3 * extent.max()).mean() > 0.95:
            message = "the head is below the feet all the time: the vertical axis points down"
            return [_finding("up", "refused", message, value=float(np.median(rise)))]
    return []


def _named(motion: SkeletonMotion | Clip) -> tuple[list[int], list[int]]:
    """Indices of the head and of the feet, where the body names them."""
    names = motion.joints if isinstance(motion, SkeletonMotion) else Character.load(motion.character).body_names
    low = [name.lower() for name in names]
    head = [i for i, name in enumerate(low) if "head" in name]
    return head, [i for i, name in enumerate(low) if "foot" in name or "ankle" in name or "toe" in name]


def _mend_floor(motion: M) -> tuple[M, list[Finding]]:
    """A clip whose feet stand at one wrong height is shifted; other wrong heights are noted.

    Only a Clip has feet of known shape. A skeleton's lowest joint is 0 to 0.15 m over its sole, nobody knows how much.
    """
    if isinstance(motion, SkeletonMotion):
        low = motion.pose()[0][..., 2].min(1)
    else:
        body = Character.load(motion.character)
        low = np.concatenate([lowest_point(body, motion.qpos[t : t + 2048]) for t in range(0, len(motion.qpos), 2048)])
    window = max(1, round(WINDOW_SECONDS * motion.fps))
    starts = range(0, max(len(low) - window // 2, 1), window)
    stance = np.array([np.percentile(low[t : t + window], 5) for t in starts])
    level, spread = float(np.median(stance)), float(np.ptp(stance))
    if isinstance(motion, SkeletonMotion):
        if not -0.05 < level < 0.2:
            message = f"the lowest joint stands {level:+.3f} m over the floor; the floor is settled on the character"
            return motion, [_finding("floor", "note", message, value=level)]
        return motion, []
    if spread > FLOOR_SPREAD:
        slope = float(np.polyfit(np.arange(len(stance)) * WINDOW_SECONDS, stance, 1)[0])
        frame = int(low.argmin()) if level < 0 else int(low.argmax())
        kind = f"drifts by {100 * slope:+.1f} cm/s" if _is_line(stance) else "changes"
        message = (
            f"the floor {kind}: feet stand between {stance.min():+.3f} and {stance.max():+.3f} m (stairs, or drift)"
        )
        if stance.min() < -FLOOR_WRONG:
            message += ": under the floor, as where the path is told along other axes or in another unit than the body"
            return motion, [_finding("floor", "refused", message, frame=int(low.argmin()), value=spread)]
        return motion, [_finding("floor", "note", message, frame=frame, value=spread)]
    found = []
    if abs(level) > FLOOR and (np.sign(level) * stance).min() > FLOOR / 2:
        message = f"the feet stand {level:+.3f} m over the floor all the time; shifted onto it"
        found.append(_finding("floor", "fixed", message, value=level))
        qpos = motion.qpos.copy()
        qpos[:, 2] -= level
        motion, low = replace(motion, qpos=qpos), low - level
    if low.min() < -FLOOR_DEEP:
        message = f"{-low.min():.2f} m under the floor"
        found.append(_finding("floor", "note", message, frame=int(low.argmin()), value=float(low.min())))
    return motion, found


def _is_line(stance: np.ndarray) -> bool:
    if len(stance) < 3:
        return False
    time = np.arange(len(stance))
    rest = stance - np.polyval(np.polyfit(time, stance, 1), time)
    return bool(rest.var() < 0.1 * stance.var())
