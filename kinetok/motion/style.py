"""Styles: a gait as somebody else might walk it. Longer or shorter steps, another carriage, other arms.

    clip = restyle(walk, amount=1.0, seed=3)          # a loop like the one given, with a pose and a stride of its own

A tracker that knows two walkers follows no third (docs/log.md). A style is drawn once for the whole gait: legs,
arms and trunk swing by more or less than they did, about a mean pose that is moved a little, alike on both sides; it is
slower or faster.
Then the body is put back on its feet: soles keep the tilt they had, the root stays as high above its lowest point as
that was above the floor, and it travels as much further or less far as the standing foot says, so that it slides no
more than it did.

Nothing here simulates: the result is a reference, to be tracked like any other.
"""

from dataclasses import replace

import mujoco
import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import kinematics, lowest_point

FPS = 60.0
SWING = {"legs": 0.3, "rest": 0.5}  # how much more or less the joints swing
MOVE = {"legs": 0.06, "rest": 0.2}  # radians, standard deviation of what moves their means
LEAN = 0.05  # radians, standard deviation of the root's pitch
TEMPO = 1.25  # times as fast or slow at most
STANDS = 0.01  # metres: a foot this much higher than the other one carries 1/e of its weight


def restyle(clip: Clip, *, amount: float = 1.0, seed: int = 0) -> Clip:
    """The gait `clip`, a loop, in a style drawn by `seed`, at 60 frames per second. amount: 0 changes next to nothing.

    Raises ValueError for a clip that is no loop.
    """
    if not clip.loop or amount < 0:
        raise ValueError(f"clip {clip.name!r}: a style needs a loop and an amount of at least 0, not {amount}")
    body, rng = Character.load(clip.character), np.random.default_rng(seed)
    frames = max(round(clip.seconds * FPS), 2)
    qpos = clip.at(np.arange(frames + 1) * clip.seconds / frames)
    motion = kinematics(body, qpos, FPS)
    legs, arms = _carrying(body, "feet"), _carrying(body, "hands")
    angles = body.pose_to_ctrl(qpos)
    mean = angles[:-1].mean(0)
    stride, arm, trunk = rng.uniform(-1, 1, 3) * (SWING["legs"], SWING["rest"], SWING["rest"]) * amount
    swing = np.where(legs, stride, np.where(arms, arm, trunk))
    move = _alike(body, np.where(legs, MOVE["legs"], MOVE["rest"]) * rng.standard_normal(body.nu) * amount)
    styled = _pose(body, qpos, mean + move + (1 + swing) * (angles - mean))
    pitch = np.array([0.0, rng.standard_normal() * LEAN * amount, 0.0])
    styled[:, 3:7] = rotation.multiply(qpos[:, 3:7], rotation.from_rotvec(np.tile(pitch, (frames + 1, 1))))
    _level_(body, styled, motion.xquat)
    styled[:, 2] = 0
    styled[:, 2] = lowest_point(body, qpos) - lowest_point(body, styled)
    styled[:, :2] = _path(body, qpos, styled)
    rate = FPS * TEMPO ** (rng.uniform(-1, 1) * amount)
    return replace(
        clip,
        name=f"{clip.name}-style",
        qpos=styled,
        fps=rate,
        source=f"{clip.source}, styled by {amount:g}, seed {seed}",
    )


def _carrying(body: Character, role: str) -> np.ndarray:
    """Which actuators (nu,) move what carries one of the bodies of a role and none of the others; of a role that the
    character does not name, none."""
    chains = []
    for end in body.bodies(role) if role in body.roles else []:
        chain = set()
        while body.parents[end] >= 0:
            chain.add(end)
            end = body.parents[end]
        chains.append(chain)
    chain = set().union(*(own.difference(*(other for other in chains if other is not own)) for own in chains))
    bodies = body.model.dof_bodyid[body.dof] - 1  # without the world
    return np.isin(bodies, list(chain))


def _pose(body: Character, qpos: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Poses (T, nq) like qpos with the joint angles (T, nu) of `pose_to_ctrl`, within their limits."""
    out, model = qpos.copy(), body.model
    low, high = np.full(body.nq, -np.inf), np.full(body.nq, np.inf)
    limited = model.jnt_limited.astype(bool)
    low[model.jnt_qposadr[limited]], high[model.jnt_qposadr[limited]] = model.jnt_range[limited].T
    for q, u in body.hinge:
        out[:, q] = angles[:, u].clip(low[q], high[q])
    for q, u in body.ball:
        out[:, q : q + 4] = rotation.from_rotvec(angles[:, u : u + 3])
    return out


def _alike(body: Character, change: np.ndarray) -> np.ndarray:
    """A change (nu,) of joint angles made the same for both sides, where the character has sides."""
    if "mirror" not in body.roles:
        return change
    rest = body.stand()[None]
    image = body.pose_to_ctrl(body.mirror_qpos(_pose(body, rest, change[None])))[0]
    return (change + image) / np.sqrt(2)


def _level_(body: Character, qpos: np.ndarray, before: np.ndarray) -> None:
    """Give feet that hang on a ball joint the orientations (T, B, 4) in the world that they had."""
    after, model = kinematics(body, qpos, FPS).xquat, body.model
    for foot in body.bodies("feet"):
        joint = model.body_jntadr[foot + 1]
        if model.body_jntnum[foot + 1] == 1 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            hang = rotation.multiply(after[:, body.parents[foot]], model.body_quat[foot + 1])
            start = model.jnt_qposadr[joint]
            qpos[:, start : start + 4] = rotation.multiply(rotation.conjugate(hang), before[:, foot])


def _path(body: Character, qpos: np.ndarray, styled: np.ndarray) -> np.ndarray:
    """Where the styled root (T, 2) must go for feet that stand to move as little as they did: as the root went, and by
    as much further as the standing foot, seen from the root, goes further back. Straight ahead over the cycle."""
    feet = body.bodies("feet")
    height = kinematics(body, qpos, FPS).xpos[:, feet, 2]
    weight = np.exp(-(height - height.min(0)) / STANDS) + 1e-6
    weight = (weight[1:] + weight[:-1]) / 2
    weight = (weight / weight.sum(1, keepdims=True))[..., None]
    steps = []
    for poses in (qpos, styled):
        still = poses.copy()
        still[:, :2] = 0
        steps.append(-(np.diff(kinematics(body, still, FPS).xpos[:, feet, :2], axis=0) * weight).sum(1))
    further = steps[1] - steps[0]
    way = qpos[-1, :2] - qpos[0, :2]
    aside = np.array([-way[1], way[0]]) / max(float(np.linalg.norm(way)), 1e-9)
    further -= (further @ aside).mean() * aside
    return qpos[:, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(further, axis=0)])
