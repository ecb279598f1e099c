"""Steering: move in a direction at a speed and face where told, as with a joystick. GPC app. D.1, eq. 11-13.

    task = Steering(SteeringConfig(), character, qpos, qvel, rows=64)   # starts as in `free`, none of them lying
    env = Env(EnvConfig(), task, rows=64)

The observation of a row is state | task (see `layout`): proprioception; the velocity asked for (direction times
speed) and the facing asked for (a unit vector), both in the heading frame: 4 numbers. Ours, as the paper is silent:
how often commands change and by how much (a quarter turn at most), the speeds (a walk's; the packaged gaits have none
between a walk's and a jog's), and the facing, which nine times of ten is the direction: walking sideways and backwards
is not among the recorded motions. A speed of zero is never asked for: eq. 12 rewards no velocity against the
direction, however small.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from kinetok import rotation
from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.sim.batch import ALL, BodyState, Rows
from kinetok.sim.tasks.marker import GOAL, SIDE, Marker
from kinetok.sim.tasks.upright import Upright, check_ranges, direction, in_heading, later, length

AHEAD = 1.5  # seconds that hindsight looks ahead at most


@dataclass(frozen=True, kw_only=True)
class SteeringConfig:
    """velocity_scale: alpha_v; tangent_weight: beta; direction_weight, facing_weight: of eq. 11 (GPC table 11).
    seconds: range of how long a command stays; speed: range of v*, m/s; turn: largest change of the direction, radians;
    free_facing: share of commands whose facing is drawn at random; fall_height: as in TargetConfig (ours)."""

    kind: Literal["steering"] = "steering"
    velocity_scale: float = 0.25
    tangent_weight: float = 0.1
    direction_weight: float = 0.7
    facing_weight: float = 0.3
    seconds: tuple[float, float] = (2.0, 5.0)
    speed: tuple[float, float] = (0.7, 1.2)
    turn: float = np.pi / 2
    free_facing: float = 0.1
    fall_height: float = 0.5

    def __post_init__(self) -> None:
        check_ranges(seconds=self.seconds, speed=self.speed)
        if not (0 <= self.free_facing <= 1 and 0 <= self.turn <= np.pi):
            raise ConfigError(f"free_facing is a share and turn at most pi, not {self.free_facing} and {self.turn}")

    def restless(self, seconds: tuple[float, float]) -> "SteeringConfig":
        """The same task, in which something else is asked after so many seconds."""
        return replace(self, seconds=seconds)


class Steering:
    """The task of `rows` worlds. angle, facing (N,): of direction and facing, radians, world frame; speed (N,): m/s."""

    def __init__(
        self,
        config: SteeringConfig,
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
        self.angle, self.facing, self.speed = (np.zeros(rows, dtype=np.float32) for _ in range(3))
        self.left = np.zeros(rows, dtype=int)  # control steps until the next command

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Start states of rows ids, and a first command for each."""
        qpos, qvel = self.world.start(ids, rng)
        self.angle[ids] = rotation.heading(qpos[:, 3:7])
        self._command(ids)
        return qpos, qvel

    def spread(self) -> None:
        """What is asked of each row has been asked for a while."""
        self.left = (self.left * self.world.rng.random(len(self.left))).astype(int)

    def advance(self) -> None:
        """Time goes on by one control step; a command whose time is up gives way to the next."""
        self.left -= 1
        due = np.flatnonzero(self.left <= 0)
        if len(due):
            self._command(due)

    def observe(self, body: BodyState, ids: Rows = ALL, out: np.ndarray | None = None) -> np.ndarray:
        """state | task (n, O) float32 of all rows or of rows ids."""
        obs, task = self.world.blank(body, out)
        velocity = self.speed[ids, None] * direction(self.angle[ids])
        task[:, :2] = in_heading(velocity, rotation.heading(body.quat))
        task[:, 2:] = in_heading(direction(self.facing[ids]), rotation.heading(body.quat))
        return obs

    def reward(self, body: BodyState) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Eq. 11, of the root's velocity now (eq. 12) and its heading (eq. 13)."""
        config, velocity, ahead = self.config, body.linear[:, 0, :2], direction(self.angle)
        along = velocity[:, 0] * ahead[:, 0] + velocity[:, 1] * ahead[:, 1]
        drift = velocity - along[:, None] * ahead
        square = (self.speed - along) ** 2 + config.tangent_weight * (drift[:, 0] ** 2 + drift[:, 1] ** 2)
        towards = np.where(along > 0, np.exp(-config.velocity_scale * square), 0.0)
        aligned = np.maximum(np.cos(rotation.heading(body.quat) - self.facing), 0.0)
        terms = {"direction": config.direction_weight * towards, "facing": config.facing_weight * aligned}
        return terms["direction"] + terms["facing"], terms

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        """terminated: fallen, or not a number; truncated: never."""
        return self.world.over(body)

    def measure(self, body: BodyState) -> dict[str, np.ndarray]:
        """(N,) by name, for a `Scorecard`: |v - v* d| of the root's velocity now, which sways with every step, and the
        angle between heading and facing."""
        asked = self.speed[:, None] * direction(self.angle)
        aside = rotation.heading(body.quat) - self.facing
        return {
            "velocity_error_mps": length(body.linear[:, 0, :2] - asked),
            "heading_error_rad": np.abs(np.arctan2(np.sin(aside), np.cos(aside))),
        }

    def hindsight(
        self, root: np.ndarray, heading: np.ndarray, ends: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Task observations (T, N, C) that a motion fulfilled, and where there is one (T, N): root (T, N, 2) metres and
        heading (T, N) radians of what was done; ends (T, N): the last step that step t may look ahead to.

        The command is the mean velocity of a third of a second, up to AHEAD seconds later, and the facing that of its
        end: what the body does now says little about what comes much later.
        """
        hz, now = self.control_hz, np.arange(len(root))[:, None]
        ahead = now + rng.integers(hz // 2, round(AHEAD * hz) + 1, heading.shape)
        velocity = (later(root, ahead) - later(root, ahead - hz // 3)) * (hz / (hz // 3))
        facing = direction(later(heading, ahead))
        c = np.concatenate([in_heading(velocity, heading), in_heading(facing, heading)], axis=-1)
        return c, ahead <= ends

    def wish(self, c: np.ndarray) -> np.ndarray:
        """Where the root should be in a second (N, 2), metres in its heading frame, by task observations c (N, 4)."""
        return c[:, :2]

    def markers(self, row: int) -> list[Marker]:
        """On the floor an arrow to where the root should be in a second; above the head a small one to the facing."""
        x, y, z = self.world.root[row].tolist()
        dx, dy = (self.speed[row] * direction(self.angle[row])).tolist()
        fx, fy = (0.6 * direction(self.facing[row])).tolist()
        return [
            Marker(shape="arrow", pos=(x, y, 0.03), end=(x + dx, y + dy, 0.03), radius=0.06, rgba=GOAL),
            Marker(shape="arrow", pos=(x, y, z + 0.9), end=(x + fx, y + fy, z + 0.9), radius=0.04, rgba=SIDE),
        ]

    def finished(self, ids: np.ndarray, terminated: np.ndarray) -> None:
        """Nothing to learn from an episode."""

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, state: dict) -> None:
        """There is no state but the environment's generator."""

    def _command(self, ids: np.ndarray) -> None:
        config, rng, n = self.config, self.world.rng, len(ids)
        self.angle[ids] += rng.uniform(-config.turn, config.turn, n)
        aside = np.where(rng.random(n) < config.free_facing, rng.uniform(-np.pi, np.pi, n), 0.0)
        self.facing[ids] = self.angle[ids] + aside
        self.speed[ids] = rng.uniform(*config.speed, n)
        self.left[ids] = (rng.uniform(*config.seconds, n) * self.control_hz).round()
