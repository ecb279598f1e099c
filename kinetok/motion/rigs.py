"""Which joint of a foreign skeleton is which part of a body: a table of known rigs, and names as a last resort.

    rig = find_rig(motion)                                      # by family, by joint names, by matching names
    rig = find_rig(motion, {"left_thigh": "Oberschenkel_L"})    # the given ones first, the rest as above
    motion.joints[rig.parts["left_thigh"]], rig.how

A part is named by the joint at its upper end: "left_shin" is the knee, "left_foot" the ankle, "left_hand" the
wrist. Toes and head may be missing; the chest is the joint at which both arms meet, unless it is given.
A rig with other parts missing is refused with what is missing and what there is. Names only, no motion.
"""

import re
from dataclasses import dataclass

from kinetok.motion.skeleton import SkeletonMotion

LIMBS = ("thigh", "shin", "foot", "upper_arm", "lower_arm", "hand")
REQUIRED = ("pelvis", *(f"{side}_{limb}" for side in ("left", "right") for limb in LIMBS))
OPTIONAL = ("chest", "head", "left_toe", "right_toe")


class RigError(ValueError):
    """A skeleton whose parts cannot be told; the message lists what is missing, what there is, and the remedy."""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """parts: generic part name -> index of the source joint at its upper end; how: "family ...", "names", "given"."""

    parts: dict[str, int]
    how: str


def _table(pelvis: str, head: str, sides: tuple[str, str], **limbs: str) -> dict[str, str]:
    """Part -> joint name; {} in a limb's name stands for the side's spelling. A body without a head names none."""
    named = {"pelvis": pelvis} | ({"head": head} if head else {})
    for side, spelling in zip(("left", "right"), sides, strict=True):
        named |= {f"{side}_{limb}": name.format(spelling) for limb, name in limbs.items()}
    return named


_LEFT_RIGHT = ("Left", "Right")
# MotionBuilder, Mixamo, HumanIK; joints of no length (LHipJoint, LowerBack) are passed over
_MOTIONBUILDER = {
    "thigh": "{}UpLeg", "shin": "{}Leg", "foot": "{}Foot", "toe": "{}ToeBase",
    "upper_arm": "{}Arm", "lower_arm": "{}ForeArm", "hand": "{}Hand",
}  # fmt: skip
_MIXAMO = _table("Hips", "Head", _LEFT_RIGHT, **_MOTIONBUILDER)

RIGS: dict[str, dict[str, str]] = {
    "mixamo-like": _MIXAMO,
    "cmu-motionbuilder": _MIXAMO,
    "fair1": _MIXAMO,
    "pymo": _MIXAMO,
    "cmu-daz": _table(
        "hip", "head", ("l", "r"),
        thigh="{}Thigh", shin="{}Shin", foot="{}Foot", upper_arm="{}Shldr", lower_arm="{}ForeArm", hand="{}Hand",
    ),
    # here LeftHip is the thigh and LeftShoulder the upper arm
    "cmu-3dsmax": _table(
        "Hips", "Head", _LEFT_RIGHT,
        thigh="{}Hip", shin="{}Knee", foot="{}Ankle", toe="{}Toe",
        upper_arm="{}Shoulder", lower_arm="{}Elbow", hand="{}Wrist",
    ),
    "snu-mass": _table(
        "Character1_Hips", "Character1_Head", _LEFT_RIGHT,
        **{limb: "Character1_" + name for limb, name in _MOTIONBUILDER.items()},
    ),
    "cmu-asf": _table(
        "root", "head", ("l", "r"),
        thigh="{}femur", shin="{}tibia", foot="{}foot", toe="{}toes",
        upper_arm="{}humerus", lower_arm="{}radius", hand="{}wrist",
    ),
    # SMPL's foot joint is the ball of the foot
    "smpl": _table(
        "pelvis", "head", ("left", "right"),
        thigh="{}_hip", shin="{}_knee", foot="{}_ankle", toe="{}_foot",
        upper_arm="{}_shoulder", lower_arm="{}_elbow", hand="{}_wrist",
    ),
    "amp": _table(
        "pelvis", "head", ("left", "right"),
        thigh="{}_thigh", shin="{}_shin", foot="{}_foot",
        upper_arm="{}_upper_arm", lower_arm="{}_lower_arm", hand="{}_hand",
    ),
    # the G1's links, as exported here: of three hinges in a row the one at the upper end of the limb
    "unitree": _table(
        "pelvis", "", ("left", "right"),
        thigh="{}_hip_roll_link", shin="{}_knee_link", foot="{}_ankle_roll_link",
        upper_arm="{}_shoulder_roll_link", lower_arm="{}_elbow_link", hand="{}_wrist_yaw_link",
    ),
}  # fmt: skip

# first match wins: where a rig has both, the later word names the neighbour ("LeftShoulder" beside "LeftArm")
WORDS = {
    "pelvis": ("hips", "pelvis", "hip", "root"),
    "head": ("head",),
    "thigh": ("upleg", "upperleg", "thigh", "femur", "hip"),
    "shin": ("lowerleg", "lowleg", "shin", "calf", "tibia", "knee", "leg"),
    "foot": ("ankle", "foot"),
    "toe": ("toebase", "toes", "toe", "ball", "foot"),
    "upper_arm": ("upperarm", "uparm", "humerus", "shldr", "arm", "shoulder"),
    "lower_arm": ("forearm", "lowerarm", "lowarm", "radius", "elbow"),
    "hand": ("wrist", "hand"),
}
CENTRAL = ("pelvis", "head")


def find_rig(motion: SkeletonMotion, parts: dict[str, str] | None = None) -> Rig:
    """Tell the parts of a skeleton. parts: part -> joint name, given by the user; they win over every table."""
    given = _given(motion, parts or {})
    family, table = known_family(motion)
    found = dict(table) if table else _by_words(motion.joints)
    found = {part: motion.joints.index(name) for part, name in found.items()} | given
    missing = [part for part in REQUIRED if part not in found]
    if missing:
        raise RigError(
            f"motion {motion.name!r}: cannot tell which joints are {', '.join(missing)}; the skeleton has "
            f"{', '.join(motion.joints)}. Name them: --part {missing[0]}=JOINT ..., in Python "
            f"parts={{{missing[0]!r}: <joint>, ...}}"
        )
    found.setdefault("chest", _meeting(motion.parents, found["left_upper_arm"], found["right_upper_arm"]))
    _check_tree(motion, found)
    how = "given" if given else f"family {family}" if family else "names"
    return Rig(parts=found, how=how)


def _given(motion: SkeletonMotion, parts: dict[str, str]) -> dict[str, int]:
    for part, name in parts.items():
        if part not in (*REQUIRED, *OPTIONAL):
            raise RigError(f"parts: {part!r} is no part of a body; parts are {', '.join((*REQUIRED, *OPTIONAL))}")
        if name not in motion.joints:
            raise RigError(f"parts: {part!r}: no joint {name!r}; the skeleton has {', '.join(motion.joints)}")
    return {part: motion.joints.index(name) for part, name in parts.items()}


def known_family(motion: SkeletonMotion) -> tuple[str, dict[str, str]]:
    """The family whose every joint is there: the motion's own first, then the table in order."""
    full = {name.rpartition(":")[2]: name for name in motion.joints}  # "mixamorig:Hips"
    for family in (motion.family, *RIGS):
        if family in RIGS and full.keys() >= set(RIGS[family].values()):
            return family, {part: full[name] for part, name in RIGS[family].items()}
    return "", {}


def _by_words(joints: tuple[str, ...]) -> dict[str, str]:
    """Part -> joint name by the words in the names; of joints with the same word the first (uppermost) is taken."""
    spelled = {}
    for name in joints:
        spelled.setdefault(_spell(name), name)
    found = {}
    for limb, words in WORDS.items():
        for side in ("",) if limb in CENTRAL else ("left", "right"):
            names = [spelled[side, word] for word in words if (side, word) in spelled]
            free = [name for name in names if name not in found.values()]
            if free:
                found[f"{side}_{limb}".lstrip("_")] = free[0]
    return found


def _spell(name: str) -> tuple[str, str]:
    """ "mixamorig:LeftUpLeg", "L_Hip", "lThigh", "Bip01 R Calf" -> side ("left", "right" or "") and the word."""
    name = re.sub(r"^(Character\d+|mixamorig\d*|[Bb]ip\d+)[_ :]*", "", name.rpartition(":")[2])
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    words = [word.lower() for word in words if word.lower() not in ("joint", "jnt", "bone", "link", "body")]
    sides = {"l": "left", "left": "left", "r": "right", "right": "right"}
    side = next((sides[word] for word in words if word in sides), "")
    word = "".join(word for word in words if word not in sides)
    if not side and word[:1] in "lr" and any(word[1:] in known for known in WORDS.values()):
        side, word = sides[word[0]], word[1:]  # "lfemur"
    return side, word


def _ancestors(parents: tuple[int, ...], joint: int) -> list[int]:
    """The joint itself, its parent, ... up to the root."""
    chain = [joint]
    while parents[chain[-1]] >= 0:
        chain.append(parents[chain[-1]])
    return chain


def _meeting(parents: tuple[int, ...], a: int, b: int) -> int:
    """The lowest joint above both."""
    above = set(_ancestors(parents, b))
    return next(joint for joint in _ancestors(parents, a) if joint in above)


def _check_tree(motion: SkeletonMotion, found: dict[str, int]) -> None:
    """Every limb hangs together: the shin below the thigh, the foot below the shin, and so on."""
    for side in ("left", "right"):
        for upper, lower in (
            ("pelvis", f"{side}_thigh"), (f"{side}_thigh", f"{side}_shin"), (f"{side}_shin", f"{side}_foot"),
            ("chest", f"{side}_upper_arm"), (f"{side}_upper_arm", f"{side}_lower_arm"),
            (f"{side}_lower_arm", f"{side}_hand"),
        ):  # fmt: skip
            if found[upper] not in _ancestors(motion.parents, found[lower]) or found[upper] == found[lower]:
                raise RigError(
                    f"motion {motion.name!r}: {lower} is joint {motion.joints[found[lower]]!r}, which is not below "
                    f"{motion.joints[found[upper]]!r} ({upper}); name the right ones in parts={{...}}"
                )
