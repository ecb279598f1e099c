"""Target: go to a place on the floor; a new one comes every few seconds. GPC's target reaching (app. D.1, eq. 10).

    task = Target(TargetConfig(), character, qpos, qvel, rows=64)   # starts as in `free`, none of them lying
    env = Env(EnvConfig(), task, rows=64)

The observation of a row is state | task (see `layout`): proprioception, and the target in the heading frame, 2
numbers in metres, as in the paper, and its direction, a unit vector (ours: what turns a walker is the direction, and
a small network learns to read it off the metres late). The paper is silent on how far targets lie: up to 5 m here,
which a walk of 1 m/s (the recorded ones' pace) reaches before the next one comes, from behind too.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from kinetok import rotation
from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.sim.batch import ALL, BodyState, Rows
from kinetok.sim.tasks.marker import DONE, GOAL, Marker
from kinetok.sim.tasks.upright import Upright, check_ranges, direction, in_heading, later, length

AHEAD = 2.0  # seconds that hindsight looks ahead at most
WALKING, RESTING = 0.4, 0.15  # m/s over half a second
STAY = 0.1  # metres to the nearest target of a demonstration
STRIDE = 1.2  # metres that a demonstration wants to come nearer in a second
REST = 0.6  # of `near`: where it wants to come to rest


@dataclass(frozen=True, kw_only=True)
class TargetConfig:
    """scale: alpha_pos per metre; near: eps_prox, metres within which the target is reached; full: metres within which
    the reward is full, eps_prox too in the paper: less of it draws the character further in; seconds: range of
    tau_reset, how long a target stays; distance: range in metres from the root to a new target, whose direction is
    random; fall_height: metres of the root below which an episode fails (GPC table 11; full apart from near, distance,
    fall_height: ours)."""

    kind: Literal["target"] = "target"
    scale: float = 0.42
    near: float = 0.5
    full: float = 0.5
    seconds: tuple[float, float] = (6.0, 8.0)
    distance: tuple[float, float] = (1.0, 5.0)
    fall_height: float = 0.5

    def __post_init__(self) -> None:
        check_ranges(seconds=self.seconds, distance=self.distance)
        if not self.full >= 0:
            raise ConfigError(f"full is metres within which the reward is full, 0 for none; not {self.full}")
        if self.distance[1] <= self.near:
            raise ConfigError(f"distance {self.distance} lies within near {self.near} m: reached without a step")

    def restless(self, seconds: tuple[float, float]) -> "TargetConfig":
        """The same task, in which something else is asked after so many seconds, now and then to stay where one is:
        who is sent on before it arrives never shows how to come to rest there."""
        return replace(self, seconds=seconds, distance=(STAY, self.distance[1]))


class Target:
    """The task of `rows` worlds. target (N, 2): metres, world frame; reached (N,): whether the root has come near."""

    def __init__(
        self,
        config: TargetConfig,
        character: Character,
        qpos: np.ndarray,
        qvel: np.ndarray,
        *,
        rows: int,
        starts: np.ndarray | None = None,
        control_hz: int = 30,
    ):
        self.config, self.character, self.control_hz = config, character, control_hz
        self.world = Upright(character, qpos, qvel, rows=rows, starts=starts, fall_height=config.fall_height, numbers=4)
        self.layout, self.obs_size = self.world.layout, self.world.obs_size
        self.target = np.zeros((rows, 2), dtype=np.float32)
        self.left = np.zeros(rows, dtype=int)  # control steps until the next target
        self.reached = np.zeros(rows, dtype=bool)
        self._none = np.full(rows, np.nan, dtype=np.float32)
        self._success, self._final = self._none, self._none

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Start states of rows ids, and a first target for each."""
        qpos, qvel = self.world.start(ids, rng)
        self._place(ids)
        return qpos, qvel

    def spread(self) -> None:
        """What is asked of each row has been asked for a while."""
        self.left = (self.left * self.world.rng.random(len(self.left))).astype(int)

    def advance(self) -> None:
        """Time goes on by one control step; a target whose time is up gives way to one around the root as last seen."""
        self._success, self._final = self._none, self._none
        self.left -= 1
        due = np.flatnonzero(self.left <= 0)
        if len(due):
            self._success, self._final = self._none.copy(), self._none.copy()
            self._success[due] = self.reached[due]
            self._final[due] = length(self.target[due] - self.world.root[due, :2])
            self._place(due)

    def observe(self, body: BodyState, ids: Rows = ALL, out: np.ndarray | None = None) -> np.ndarray:
        """state | task (n, O) float32 of all rows or of rows ids."""
        obs, task = self.world.blank(body, out)
        task[:] = _seen(in_heading(self.target[ids] - body.pos[:, 0, :2], rotation.heading(body.quat)))
        return obs

    def reward(self, body: BodyState) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Eq. 10: 1 within eps_prox (`full`), exp(-alpha_pos d) further away."""
        distance = length(body.pos[:, 0, :2] - self.target)
        reward = np.where(distance < self.config.full, 1.0, np.exp(-self.config.scale * distance))
        return reward, {"target": reward}

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        """terminated: fallen, or not a number; truncated: never. Takes note of targets reached."""
        self.reached |= length(body.pos[:, 0, :2] - self.target) < self.config.near
        return self.world.over(body)

    def measure(self, body: BodyState) -> dict[str, np.ndarray]:
        """(N,) by name, for a `Scorecard`: the distance now; success (the root came near before the time was up) and
        the last distance where a target has just given way to the next, else NaN."""
        distance = length(body.pos[:, 0, :2] - self.target)
        return {"target_distance_m": distance, "success_rate": self._success, "final_distance_m": self._final}

    def hindsight(
        self, root: np.ndarray, heading: np.ndarray, ends: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Task observations (T, N, C) that a motion fulfilled, and where there is one (T, N): root (T, N, 2) metres and
        heading (T, N) radians of what was done; ends (T, N): the last step that step t may look ahead to.

        The target is on the way that the root took after half a second to AHEAD seconds: as far on, straight, as
        one may be asked to go. Where the root came to rest it is there. A target is not where the root came much later,
        because what it does now says little about that.
        """
        hz, now = self.control_hz, np.arange(len(root))[:, None]
        longest = np.minimum(ends - now, round(AHEAD * hz))
        ahead = now + hz // 2 + (rng.random(heading.shape) * (longest - hz // 2 + 1)).astype(int)
        there = later(root, ahead)
        velocity = (there - later(root, ahead - hz // 2)) * 2
        speed = np.hypot(velocity[..., 0], velocity[..., 1])[..., None]
        on = np.where(speed > WALKING, velocity / speed.clip(1e-6), 0.0) * rng.uniform(
            0, self.config.distance[1], (*heading.shape, 1)
        )
        rests = (speed[..., 0] < RESTING) & (np.linalg.norm(there - root, axis=-1) < self.config.near)
        told = (longest >= hz // 2) & (rests | (speed[..., 0] > WALKING))
        return _seen(in_heading((there - root + on).astype(np.float32), heading)), told

    def wish(self, c: np.ndarray) -> np.ndarray:
        """Where the root should be in a second (N, 2), metres in its heading frame, by task observations c (N, 4)."""
        distance = length(c[:, :2])
        return c[:, :2] * ((distance - REST * self.config.near).clip(0, STRIDE) / distance.clip(1e-6))[:, None]

    def markers(self, row: int) -> list[Marker]:
        """A disc as large as `near` and a pole at the target, and a line to it; green once it has been reached."""
        x, y = self.target[row].tolist()
        root_x, root_y, _ = self.world.root[row].tolist()
        colour = DONE if self.reached[row] else GOAL
        return [
            Marker(shape="disc", pos=(x, y, 0.0), radius=self.config.near, rgba=colour),
            Marker(shape="pole", pos=(x, y, 0.0), end=(x, y, 1.6), radius=0.025, rgba=colour),
            Marker(shape="pole", pos=(root_x, root_y, 0.01), end=(x, y, 0.01), radius=0.012, rgba=colour),
        ]

    def finished(self, ids: np.ndarray, terminated: np.ndarray) -> None:
        """Nothing to learn from an episode."""

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, state: dict) -> None:
        """There is no state but the environment's generator."""

    def _place(self, ids: np.ndarray) -> None:
        rng, hz = self.world.rng, self.control_hz
        distance = rng.uniform(*self.config.distance, len(ids)).astype(np.float32)
        offset = distance[:, None] * direction(rng.uniform(-np.pi, np.pi, len(ids)))
        self.target[ids] = self.world.root[ids, :2] + offset
        self.left[ids] = (rng.uniform(*self.config.seconds, len(ids)) * hz).round()
        self.reached[ids] = False


def _seen(offset: np.ndarray) -> np.ndarray:
    """Task observations (..., 4) of a target at offset (..., 2): metres, and the direction."""
    return np.concatenate([offset, offset / np.linalg.norm(offset, axis=-1, keepdims=True).clip(1e-6)], axis=-1)
