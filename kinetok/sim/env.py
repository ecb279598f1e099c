"""Env: many worlds stepped together over one Task.

    env = Env(EnvConfig(), task, rows=512, threads=2, seed=0)
    obs = env.reset()
    step = env.step(action)          # action (N, nu): PD targets in radians

Env owns stepping, pushes, time-outs, failed simulations and episode sums; the task owns what is observed,
rewarded and where episodes start. terminated (the task failed) and truncated (the time or the clip is over)
are never merged: `final_obs` holds the last observation of each finished row, for bootstrapping. Finished rows
are reset within step (Gymnasium's SAME_STEP autoreset).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kinetok.motion.character import Character
from kinetok.sim.batch import ALL, BatchSim, BodyState, Rows
from kinetok.sim.reset import perturb
from kinetok.sim.scene import SceneConfig, build_scene


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """episode_seconds: longest episode; reset_noise: radians; push: m/s added to the root's horizontal velocity,
    every push_seconds on average (exactly, when push_regular); friction: range of the floor's friction;
    autoreset: reset finished rows within step; without it they simply go on."""

    scene: SceneConfig = SceneConfig()
    episode_seconds: float = 10.0
    reset_noise: float = 0.0
    push: float = 0.0
    push_seconds: float = 2.0
    push_regular: bool = False
    friction: tuple[float, float] = (1.0, 1.0)
    autoreset: bool = True


@dataclass(frozen=True, kw_only=True)
class Step:
    """obs (N, O); reward (N,); terms: reward parts (N,); terminated, truncated (N,) bool; done: ids (k,) of finished
    rows; final_obs (k, O): their last observations before the reset; failed: ids (k,) of rows that blew up."""

    obs: np.ndarray
    reward: np.ndarray
    terms: dict[str, np.ndarray]
    terminated: np.ndarray
    truncated: np.ndarray
    done: np.ndarray
    final_obs: np.ndarray
    failed: np.ndarray


class Task(Protocol):
    """One file in sim/tasks: what to start from, what to see, what to reward, when it is over.

    A step of Env calls advance, then observe for runs of the rows side by side, in threads, then reward and over; so
    observe depends on neither of the last two and changes nothing but out.
    """

    character: Character
    obs_size: int

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]: ...
    def spread(self) -> None: ...
    def advance(self) -> None: ...
    def observe(self, body: BodyState, ids: Rows = ALL, out: np.ndarray | None = None) -> np.ndarray: ...
    def reward(self, body: BodyState) -> tuple[np.ndarray, dict[str, np.ndarray]]: ...
    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]: ...
    def finished(self, ids: np.ndarray, terminated: np.ndarray) -> None: ...
    def state_dict(self) -> dict: ...
    def load_state_dict(self, state: dict) -> None: ...


class Env:
    """`rows` worlds of one task on `threads` physics threads."""

    def __init__(self, config: EnvConfig, task: Task, *, rows: int, threads: int = 0, seed: int = 0):
        self.config, self.task, self.rows = config, task, rows
        self.rng = np.random.default_rng(seed)
        self.sim = BatchSim(build_scene(task.character, config.scene), rows, threads)
        self.limit = round(config.episode_seconds * config.scene.control_hz)
        self.age, self._begun = np.zeros(rows, dtype=int), np.zeros(rows, dtype=int)  # _begun: the age at the start
        self.failed_simulations = 0
        self._returns = np.zeros(rows)
        self._finished: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        if config.friction != (1.0, 1.0):
            self.sim.set_friction(self.rng.uniform(*config.friction, rows))

    @property
    def obs_size(self) -> int:
        return self.task.obs_size

    @property
    def action_size(self) -> int:
        return self.task.character.nu

    def reset(self, *, spread: bool = False) -> np.ndarray:
        """Start every row anew; observations (N, O). spread: as if they had begun at different times, so that rows do
        not end together, nor are asked for something else together: all turning at once, then all walking straight,
        they teach a policy to forget the one while it learns the other (docs/log.md)."""
        ids = np.arange(self.rows)
        self._start(ids)
        if spread:
            self.age[:] = self._begun[:] = self.rng.integers(0, self.limit, self.rows)
            self.task.spread()
        return self.task.observe(self.sim.state())

    def step(self, action: np.ndarray) -> Step:
        """One control step for every row under PD targets (N, nu)."""
        self.task.advance()
        self.age += 1
        obs = np.empty((self.rows, self.obs_size), dtype=np.float32)

        def look(rows: slice, body: BodyState) -> None:
            self.task.observe(body, rows, obs[rows])

        failed = self.sim.step(action, self.config.scene.substeps, look)
        body = self.sim.state()
        reward, terms = self.task.reward(body)
        terminated, truncated = self.task.over(body)
        if len(failed):
            self.failed_simulations += len(failed)
            terminated[failed] = True
            reward = np.where(np.isfinite(reward), reward, 0.0)
        truncated = (truncated | (self.age >= self.limit)) & ~terminated
        self._returns += reward
        done = np.flatnonzero(terminated | truncated)
        final = obs[done]
        if len(failed):
            final = np.where(np.isfinite(final), final, 0.0)
        if len(done) and self.config.autoreset:
            self._finished.append((self._returns[done].copy(), (self.age - self._begun)[done], terminated[done]))
            self.task.finished(done, terminated[done])
            self._start(done)
            obs[done] = self.task.observe(self.sim.state(done), done)
        self._push()
        return Step(
            obs=obs,
            reward=reward.astype(np.float32),
            terms=terms,
            terminated=terminated,
            truncated=truncated,
            done=done,
            final_obs=final,
            failed=failed,
        )

    def episode_metrics(self) -> dict[str, float]:
        """Means over the episodes finished since the last call."""
        if not self._finished:
            return {}
        returns, steps, terminated = (np.concatenate(parts) for parts in zip(*self._finished, strict=True))
        self._finished.clear()
        return {
            "episode_return": float(returns.mean()),
            "episode_seconds": float(steps.mean() / self.config.scene.control_hz),
            "failure_rate": float(terminated.mean()),
        }

    def state_dict(self) -> dict:
        """What a resumed training needs besides a reset: the random state, the task's weights, the failure count."""
        return {
            "rng": self.rng.bit_generator.state,
            "task": self.task.state_dict(),
            "failed_simulations": self.failed_simulations,
        }

    def load_state_dict(self, state: dict) -> None:
        self.rng.bit_generator.state = state["rng"]
        self.task.load_state_dict(state["task"])
        self.failed_simulations = state["failed_simulations"]

    def _start(self, ids: np.ndarray) -> None:
        qpos, qvel = self.task.start(ids, self.rng)
        if self.config.reset_noise:
            qpos, qvel = perturb(self.task.character, qpos, qvel, self.config.reset_noise, self.rng)
        self.sim.set_state(ids, qpos, qvel)
        self.age[ids] = self._begun[ids] = 0
        self._returns[ids] = 0

    def _push(self) -> None:
        config = self.config
        if not config.push:
            return
        every = config.push_seconds * config.scene.control_hz
        if config.push_regular:
            ids = np.flatnonzero((self.age > 0) & (self.age % round(every) == 0))
            size = np.full(len(ids), config.push)
        else:
            ids = np.flatnonzero(self.rng.random(self.rows) < 1 / every)
            size = self.rng.uniform(0, config.push, len(ids))
        angle = self.rng.uniform(0, 2 * np.pi, len(ids))
        self.sim.add_velocity(ids, np.stack([size * np.cos(angle), size * np.sin(angle), 0 * size], axis=1))
