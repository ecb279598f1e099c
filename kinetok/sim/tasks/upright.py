"""Upright: what the tasks of a walking body share. It begins as in `free`, it must not fall, it sees the plane.

    world = Upright(character, qpos, qvel, rows=64, starts=None, fall_height=0.5, numbers=2)
    obs, task = world.blank(body)                   # the state is filled in, task (n, 2) is a view to fill
    task[:] = in_heading(target - root, body.quat)

A task holds one of these and adds what is asked of the body. What is asked is drawn from the generator of the last
start, between starts too: the environment saves it for a resumed training.
"""

import numpy as np

from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.sim import observe
from kinetok.sim.batch import BodyState
from kinetok.sim.tasks.free import Free


class Upright:
    """`rows` worlds of `Free` that end when the root is below fall_height metres.

    root (N, 3): where each root was last seen, world frame; rng: of the last start; layout: columns of the observation,
    "state" (observe.state_features) and "task" (`numbers` columns).
    """

    def __init__(
        self,
        character: Character,
        qpos: np.ndarray,
        qvel: np.ndarray,
        *,
        rows: int,
        starts: np.ndarray | None,
        fall_height: float,
        numbers: int,
    ):
        self.free = Free(character, qpos, qvel, rows=rows, starts=starts)
        low = np.flatnonzero(qpos[:, 2] < fall_height)
        low = low if starts is None else np.intersect1d(low, starts)
        if len(low):
            raise ValueError(
                f"{len(low)} of {len(qpos)} start states, first {low[0]}, have their root below fall_height "
                f"{fall_height} m and would end at once; leave them out (keep qpos[:, 2] >= fall_height) or lower "
                "fall_height"
            )
        self.character, self.fall_height = character, fall_height
        state = self.free.obs_size
        self.layout = {"state": slice(0, state), "task": slice(state, state + numbers)}
        self.obs_size = state + numbers
        self.root = np.zeros((rows, 3), dtype=np.float32)
        self.rng = np.random.default_rng(0)

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Start states of rows ids; their roots and rng are kept."""
        self.rng = rng
        qpos, qvel = self.free.start(ids, rng)
        self.root[ids] = qpos[:, :3]
        return qpos, qvel

    def blank(self, body: BodyState, out: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Observations (n, O) float32 with the state filled in, and the task's columns of them, yet to be filled."""
        obs = np.empty((len(body.pos), self.obs_size), dtype=np.float32) if out is None else out
        observe.state_features(body, obs, self.layout["state"].start)
        return obs, obs[:, self.layout["task"]]

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        """terminated: fallen, or the state is not a number; truncated: never. Keeps the roots that are numbers."""
        broken, truncated = self.free.over(body)
        self.root = np.where(broken[:, None], self.root, body.pos[:, 0])
        return broken | (body.pos[:, 0, 2] < self.fall_height), truncated


def in_heading(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """World-frame vectors of the plane (..., 2) or (..., K, 2), float32, as headings angle (...), radians, see them: x
    ahead, y left."""
    angle = angle.reshape(*angle.shape, *(1,) * (vectors.ndim - 1 - angle.ndim))
    cos, sin, x, y = np.cos(angle), np.sin(angle), vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1).astype(np.float32)


def direction(angle: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 2) of the plane at angle (...,) radians, float32."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)


def length(vectors: np.ndarray) -> np.ndarray:
    """Norms (n,) of vectors (n, 2)."""
    return np.hypot(vectors[:, 0], vectors[:, 1])


def check_ranges(**ranges: tuple[float, float]) -> None:
    """Refuse ranges whose ends are not positive and in order."""
    for name, (low, high) in ranges.items():
        if not 0 < low <= high:
            raise ConfigError(f"{name} must be two positive numbers in order, not {(low, high)}")


def later(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """values (T, N, ...) at step steps (T, N) instead, clipped to the last."""
    steps = steps.clip(0, len(values) - 1)
    return np.take_along_axis(values, steps.reshape(*steps.shape, *(1,) * (values.ndim - 2)), axis=0)
