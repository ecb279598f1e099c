"""The roles of a character: a small JSON object beside its MJCF that says which body is what.

    {"feet": ["left_foot", "right_foot"], "hands": ["left_hand", "right_hand"], "head": "head",
     "mirror": {"swap": "left_ <-> right_", "plane": "xz"},
     "retarget": {"pelvis": "pelvis", "left_thigh": "left_thigh", ...},
     "stand": {"left_knee": 0.3, "left_shoulder": [-1.1, 0, 0]}}

Every key is optional: what needs one that is missing says so. `retarget` names the bodies of PARTS, `stand` the joint
angles of the standing pose (rotation vectors for ball joints), `mirror` which names change sides; every other key is
a role of one body or a list of them. Names that the MJCF lacks, and values of another form, are refused on reading.
"""

import json
from collections.abc import Iterable
from pathlib import Path

import mujoco
import numpy as np

from kinetok.config import ConfigError, nearest

LIMBS = ("thigh", "shin", "foot", "toe", "upper_arm", "lower_arm", "hand")
PARTS = ("pelvis", "chest", "head", *(f"{side}_{limb}" for side in ("left", "right") for limb in LIMBS))
JOINTS = {"hip": "thigh", "knee": "shin", "ankle": "foot", "shoulder": "upper_arm", "elbow": "lower_arm"}
JOINTS |= {"wrist": "hand"}  # a part is also known by the joint at its upper end
PLANES = {"yz": 0, "xz": 1, "xy": 2}  # the axis that a reflection turns round


def read_roles(path: Path) -> dict:
    """The roles in a JSON file; names are checked when a character is made of them."""
    try:
        roles = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not JSON: {error}") from error
    if not isinstance(roles, dict):
        raise ConfigError(f'{path}: expected an object such as {{"feet": [...]}}, not {type(roles).__name__}')
    return roles


def check_roles(roles: dict, model: mujoco.MjModel, where: str) -> None:
    """Refuse roles that do not fit the MJCF. where: the file they came from, for messages."""
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    for role, value in roles.items():
        place = f"{where}: {role!r}"
        if role == "mirror":
            counterparts(roles, bodies, where)
        elif role == "stand":
            _check_stand(value, model, place)
        elif role == "retarget":
            for part, body in _object(value, place).items():
                _known(part, PARTS, f"{place} names the part", "one of")
                _known(body, bodies, f"{place} {part!r} names the body", "the MJCF has")
        else:
            names = [value] if isinstance(value, str) else value
            if not isinstance(names, list):
                raise ConfigError(f"{place}: expected the name of a body or a list of names, not {value!r}")
            for body in names:
                _known(body, bodies, f"{place} names the body", "the MJCF has")


def counterparts(roles: dict, bodies: list[str], where: str) -> list[int]:
    """For each body the index of its mirror image: itself, or the body whose name has the sides swapped.

    `mirror` is {"swap": "left_ <-> right_", "plane": "xz"}, or with an object of pairs as "swap": {"lfoot": "rfoot"}.
    """
    place = f"{where}: 'mirror'"
    rule = _object(roles["mirror"], place)
    if set(rule) != {"swap", "plane"} or rule["plane"] not in PLANES:
        raise ConfigError(
            f'{place}: expected {{"swap": "left_ <-> right_", "plane": "xz"}}, the plane of the root that '
            f"parts left from right being one of {', '.join(PLANES)}; not {rule!r}"
        )
    swap, images = rule["swap"], []
    if isinstance(swap, dict):
        for name in (*swap, *swap.values()):
            _known(name, bodies, f"{place} names the body", "the MJCF has")
        pairs = swap | {right: left for left, right in swap.items()}
        if len(pairs) != 2 * len(swap):
            raise ConfigError(f"{place}: a body stands twice in the pairs {swap!r}")
        return [bodies.index(pairs.get(name, name)) for name in bodies]
    sides = [side.strip() for side in swap.split("<->")] if isinstance(swap, str) else []
    if len(sides) != 2 or not all(sides) or sides[0] == sides[1]:
        raise ConfigError(f"{place}: 'swap' is {swap!r}; write it as \"left_ <-> right_\", or as pairs of body names")
    for name in bodies:
        image = name
        for here, there in (sides, sides[::-1]):
            if here in name:
                image = name.replace(here, there, 1)
                break
        if image not in bodies:
            raise ConfigError(
                f"{place}: {swap!r} makes {image!r} of the body {name!r}, and there is none of that name"
                f"{nearest(image, bodies)}"
            )
        images.append(bodies.index(image))
    return images


def _object(value: object, place: str) -> dict:
    if not isinstance(value, dict):
        raise ConfigError(f"{place}: expected an object, not {value!r}")
    return value


def _known(name: object, names: Iterable[str], what: str, has: str) -> None:
    if name not in (listed := list(names)):
        raise ConfigError(f"{what} {name!r}; {has}: {', '.join(listed)}{nearest(name, listed)}")


def _check_stand(value: object, model: mujoco.MjModel, place: str) -> None:
    joints = [model.joint(i).name for i in range(1, model.njnt)]
    for name, angle in _object(value, place).items():
        _known(name, joints, f"{place} names the joint", "the MJCF has")
        ball = model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_BALL
        numbers = angle if isinstance(angle, list) else [angle]
        if len(numbers) != (3 if ball else 1) or not all(type(x) in (int, float) and np.isfinite(x) for x in numbers):
            form = "three numbers, its rotation vector" if ball else "a number"
            raise ConfigError(f"{place}: {name!r} is {angle!r}; the joint needs {form}, in radians")
