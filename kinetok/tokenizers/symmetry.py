"""Left-right symmetry: what a tracker would do in the mirror.

    mirror = Mirror.of("humanoid", future=(1, 2, 7))
    labels = mirror.action(teacher.act(mirror.observation(obs))[0])   # the teacher's labels for a mirrored clip

A mirrored clip needs no teacher of its own. Which number of an observation becomes which, and with what sign, is
found by looking: random poses and their mirror images (Character.mirror_qpos) are observed, and columns paired that
agree everywhere. Refused where a column has no partner, as with bodies whose frames are not mirror images.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from kinetok import rotation
from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking, TrackingConfig

POSES, CLOSE = 160, 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Mirror:
    """index, sign (O,): the mirror image of an observation is obs[:, index] * sign; targets: columns of the PD
    targets, which are mirrored like actions."""

    index: Tensor = field(repr=False)
    sign: Tensor = field(repr=False)
    targets: slice

    @staticmethod
    def of(character: str, future: tuple[int, ...]) -> "Mirror":
        """Of the tracking observations of a character (built-in name or path) with this window."""
        clip = _random_motion(character)
        table = ReferenceTable(ClipLibrary.of([clip, clip.mirror()]))
        rng = np.random.default_rng(0)
        ahead = max(future) + 1
        here, reference = rng.permutation(POSES), rng.integers(0, POSES - ahead, POSES)
        seen = []
        for k in (0, 1):
            task = Tracking(TrackingConfig(future=future), table, rows=POSES)
            task.place(np.arange(POSES), np.full(POSES, k), table.first[k] + reference)
            seen.append(task.observe(table.body.rows(table.first[k] + here)).astype(np.float64))
        index, sign = _pair(*seen, name=character)
        return Mirror(index=torch.as_tensor(index), sign=torch.as_tensor(sign).float(), targets=task.layout["target"])

    def observation(self, obs: Tensor) -> Tensor:
        """The mirror images (N, O) of observations (N, O)."""
        return obs[:, self.index] * self.sign

    def action(self, action: Tensor) -> Tensor:
        """The mirror images (N, nu) of PD targets (N, nu)."""
        return action[:, self.index[self.targets] - self.targets.start] * self.sign[self.targets]


def _random_motion(name: str) -> Clip:
    """Unrelated poses, wide enough that no two numbers of an observation agree by chance."""
    rng, character = np.random.default_rng(1), Character.load(name)
    qpos = np.tile(character.stand(), (POSES, 1))
    qpos[:, :3] += rng.normal(0, 0.3, (POSES, 3))
    qpos[:, 3:7] = rotation.from_rotvec(rng.normal(0, 0.7, (POSES, 3)))
    for q, _ in character.hinge:
        qpos[:, q] += rng.normal(0, 0.5, POSES)
    for q, _ in character.ball:
        qpos[:, q : q + 4] = rotation.from_rotvec(rng.normal(0, 0.5, (POSES, 3)))
    return Clip(name="random", character=name, fps=30.0, qpos=qpos)


def _pair(plain: np.ndarray, mirrored: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """index, sign (O,) with mirrored = plain[:, index] * sign, for observations (K, O). Numbers that are always equal,
    as of bodies that never turn against each other, may share a partner."""
    size = np.linalg.norm(plain, axis=0).clip(1e-9)
    alike = (plain / size).T @ mirrored
    index = np.abs(alike).argmax(0)
    sign = np.where(alike[index, np.arange(len(index))] < 0, -1.0, 1.0)
    apart = np.abs(plain[:, index] * sign - mirrored).max(0) / np.abs(mirrored).max(0).clip(CLOSE)
    if apart.max() > CLOSE:
        raise ConfigError(
            f"character {name!r}: observation {int(apart.argmax())} has no mirror image; the frames of "
            "its left and right bodies must be mirror images (diagonal reflections)"
        )
    return index, sign
