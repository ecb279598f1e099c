"""What a skeleton file does not say: the rig family by joint names, the unit and the up axis by the body's size.

    family_of(("Hips", "LHipJoint", "LeftUpLeg", ...))       # "cmu-motionbuilder"; FAMILIES is the table
    unit, metres = unit_of(family, leg, height)              # leg and height in the file's unit
    world, rest = up_axes(motion)                            # "y", "z"

For formats that name neither unit nor up axis. The unit is that of the family if the leg then measures as a human
one; otherwise it is the one in which the leg, or without legs the body's height, is human, and the answer says
"guessed: ...". A scale that fits no unit is taken to the documented scale of its family or to a leg of LEG metres.
The up axis is the one along which the body stands, at rest and in its poses; where the two differ (a body lying
down, a y-up rig in a z-up world), the one whose floor is nearer to zero.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kinetok.motion.skeleton import SkeletonMotion

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "cmu": 0.0254 / 0.45}  # metres; cmu: 1/0.45 inch, CMU's lab
LEG, HUMAN_LEG, HUMAN_HEIGHT = 0.82, (0.6, 1.1), (1.2, 2.2)  # metres: hip joint to ankle; rest pose from end to end
FRAMES = 64  # poses that are looked at
KNEES = ("leftleg", "leftknee", "leftlowerleg", "leftshin", "leftcalf", "lshin", "lcalf", "lknee", "ltibia")
KNEES += ("llowerleg", "shinl", "calfl", "kneel", "lowerlegl")


@dataclass(frozen=True, kw_only=True)
class Family:
    """A rig known by joint names. names: those it must have, "#" standing for Left and Right, "~" for l and r, "^" for
    L and R; unit: a key of UNITS, or "" where the files follow none; scale: metres per unit, for want of a unit."""

    names: tuple[str, ...]
    unit: str = ""
    scale: float = 0.0

    def required(self) -> frozenset[str]:
        """The names, both sides written out."""
        sides = {"#": ("Left", "Right"), "~": ("l", "r"), "^": ("L", "R")}
        pairs = [(name, sides[mark]) for name in self.names for mark in sides if mark in name]
        plain = [name for name in self.names if not set(name) & set(sides)]
        return frozenset(re.sub("[#~^]", side, name) for name, both in pairs for side in both) | frozenset(plain)


# In the order they are tried: general names come last.
FAMILIES = {
    "cmu-daz": Family(names=("hip", "abdomen", "chest", "~Thigh", "~Shin", "~Shldr", "~ForeArm"), unit="cm"),
    "cmu-motionbuilder": Family(
        names=("Hips", "^HipJoint", "LowerBack", "Neck1", "#UpLeg", "#Leg", "#Arm"), unit="cmu"
    ),
    "cmu-3dsmax": Family(names=("Hips", "^HipJoint", "lowerback", "lowerneck", "#Hip", "#Knee", "#Collar"), unit="cmu"),
    "cmu-asf": Family(names=("root", "~hipjoint", "lowerback", "~femur", "~tibia", "~humerus"), unit="cmu"),
    "snu-mass": Family(names=("Character1_Hips", "Character1_Spine1", "Character1_#UpLeg"), unit="cm"),
    "fair1": Family(names=("Hips", "Spine3", "#HandEnd", "#UpLeg", "#Leg", "#Arm"), scale=0.038),
    "pymo": Family(names=("Hips", "Spine", "#Hand_End", "#UpLeg", "#Leg", "#Arm"), unit="in"),
    "mixamo-like": Family(names=("Hips", "Spine", "#UpLeg", "#Leg", "#Foot", "#Arm", "#ForeArm", "#Hand")),
}


def family_of(joints: Sequence[str]) -> str:
    """The first family all of whose names are among the joints, or "". Namespaces ("mixamorig:") are left aside."""
    names = {name.rpartition(":")[2] for name in joints}
    return next((family for family, rig in FAMILIES.items() if rig.required() <= names), "")


def rest_pose(parents: Sequence[int], offsets: np.ndarray) -> np.ndarray:
    """Joint positions (J, 3) with all rotations zero and the root at the origin, from offsets (J, 3)."""
    rest = np.zeros_like(offsets)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            rest[joint] = rest[parent] + offsets[joint]
    return rest


def leg_length(motion: SkeletonMotion) -> float:
    """From the left hip joint to the ankle, in the unit of the offsets; 0 where no name tells of a leg."""
    lengths = np.linalg.norm(motion.offsets, axis=1)
    return max((float(lengths[knee] + lengths[ankle]) for knee, ankle in _legs(motion)), default=0.0)


def unit_of(family: str, leg: float, height: float) -> tuple[str, float]:
    """Name of the unit and metres per unit; leg is 0 where there is none to measure."""
    size, (low, high) = (leg, HUMAN_LEG) if leg > 0 else (height, HUMAN_HEIGHT)
    own = FAMILIES[family].unit if family else ""
    if own and low <= size * UNITS[own] <= high:
        return own, UNITS[own]
    for name, metres in UNITS.items():
        if low <= size * metres <= high:
            return f"guessed: {name}", metres
    if not leg > 0:
        return "guessed: cm", UNITS["cm"]  # a body of no human size: nothing to measure by
    scale = FAMILIES[family].scale if family else 0.0
    scale = scale if low <= leg * scale <= high else LEG / leg
    return f"guessed: {scale:.5g} m, for a leg of {leg * scale:.2f} m", scale


def up_axes(motion: SkeletonMotion) -> tuple[str, str]:
    """Up axis of the world and of the rest pose, "y" or "z"; the latter "" where that does not stand."""
    heads = [joint for joint, name in enumerate(motion.joints) if name.lower().endswith("head")]
    ankles = [ankle for _, ankle in _legs(motion)]

    def extent(points: np.ndarray) -> np.ndarray:
        if heads and ankles:
            return np.abs(points[..., heads[0], :] - points[..., ankles, :].mean(-2))
        return np.ptp(points, axis=-2)

    x, y, z = extent(rest_pose(motion.parents, motion.offsets))
    stands = max(y, z) > 2 * min(y, z) and max(y, z) > x / 2
    rest = ("z" if z > y else "y") if stands else ""
    thin = np.linspace(0, len(motion.root) - 1, min(FRAMES, len(motion.root))).astype(int)
    points = replace(motion, local=motion.local[thin], root=motion.root[thin]).pose()[0]
    poses = np.median(extent(points), axis=0)
    world = "z" if poses[2] > poses[1] else "y"
    if rest and world != rest:
        floor = np.abs(np.percentile(points.min(1), 5, axis=0))
        world = "z" if floor[2] < floor[1] else "y"
    return world, rest


def _legs(motion: SkeletonMotion) -> list[tuple[int, int]]:
    """Left knees by name, each with the farthest of its children, the ankle."""
    found = []
    for knee, name in enumerate(motion.joints):
        feet = [joint for joint, parent in enumerate(motion.parents) if parent == knee]
        if feet and re.sub(r"[^a-z0-9]", "", name.lower()).endswith(KNEES):
            found.append((knee, max(feet, key=lambda joint: float(np.linalg.norm(motion.offsets[joint])))))
    return found
