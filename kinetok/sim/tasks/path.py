"""Path: be on a path on the floor at the right time. GPC's trajectory following (app. D.1, eq. 14).

    task = Path(PathConfig(), character, qpos, qvel, rows=64)   # starts as in `free`, none of them lying
    env = Env(EnvConfig(), task, rows=64)

The observation of a row is state | task (see `layout`): proprioception, and the next 10 waypoints, half a second
apart, in the heading frame: 20 numbers in metres. Every path begins below the root, where it heads, and goes on for
ever: arcs of half a second, each with its own turn rate, between which heading and speed do not jump. The paper is
silent on its paths; the speeds here are those of the recorded walks.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from kinetok import rotation
from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.sim.batch import ALL, BodyState, Rows
from kinetok.sim.tasks.marker import AHEAD, GOAL, Marker
from kinetok.sim.tasks.upright import Upright, check_ranges, direction, in_heading, later, length

CATCH_UP = 2.0  # seconds in which a demonstration returns to the path
JUMP = 1.0  # metres


@dataclass(frozen=True, kw_only=True)
class PathConfig:
    """scale: alpha_traj per metre (GPC table 11); waypoints, seconds: how many, up to how far ahead (app. D.1).
    speed: range along the path, m/s; acceleration: largest, m/s^2; turn: largest turn rate, rad/s; far: metres from
    the path at which an episode fails, 0 for never; jumps: range of seconds after which the whole path is shifted by up
    to a metre, none by default; fall_height: as in TargetConfig (ours)."""

    kind: Literal["path"] = "path"
    scale: float = 2.0
    waypoints: int = 10
    seconds: float = 5.0
    speed: tuple[float, float] = (0.7, 1.1)
    acceleration: float = 0.5
    turn: float = 0.6
    far: float = 0.0
    jumps: tuple[float, float] | None = None
    fall_height: float = 0.5

    def __post_init__(self) -> None:
        check_ranges(speed=self.speed, **({} if self.jumps is None else {"jumps": self.jumps}))
        if self.waypoints < 1 or min(self.seconds, self.acceleration, self.turn, self.far) < 0:
            raise ConfigError(f"a path has waypoints and no negative settings: {self}")

    def restless(self, seconds: tuple[float, float]) -> "PathConfig":
        """The same task on a path that jumps: a smooth one says little that the motion so far does not."""
        return replace(self, jumps=seconds)


class Path:
    """The task of `rows` worlds. points (N, L, 2): the path by control steps, metres, world frame, of which `now` is
    the present one; its last is at least `seconds` ahead."""

    def __init__(
        self,
        config: PathConfig,
        character: Character,
        qpos: np.ndarray,
        qvel: np.ndarray,
        *,
        rows: int,
        starts: np.ndarray | None = None,
        control_hz: int = 30,
    ):
        self.config, self.character, self.control_hz = config, character, control_hz
        self.arc = round(config.seconds / config.waypoints * control_hz)  # control steps between waypoints
        if self.arc < 1:
            raise ConfigError(f"{config.waypoints} waypoints in {config.seconds} s are closer than 1/{control_hz} s")
        numbers = 2 * config.waypoints
        self.world = Upright(
            character, qpos, qvel, rows=rows, starts=starts, fall_height=config.fall_height, numbers=numbers
        )
        self.layout, self.obs_size = self.world.layout, self.world.obs_size
        self.now = 0
        self.points = np.zeros((rows, (config.waypoints + 1) * self.arc, 2), dtype=np.float32)
        self.angle, self.speed = np.zeros(rows, dtype=np.float32), np.zeros(rows, dtype=np.float32)  # at the last point
        self.left = np.zeros(rows, dtype=int)  # control steps until the path jumps

    @property
    def target(self) -> np.ndarray:
        """Where each root should be now (N, 2)."""
        return self.points[:, self.now]

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Start states of rows ids, and for each a path that goes on as it moves."""
        qpos, qvel = self.world.start(ids, rng)
        self.angle[ids] = rotation.heading(qpos[:, 3:7])
        self.speed[ids] = np.hypot(qvel[:, 0], qvel[:, 1]).clip(*self.config.speed)
        self.points[ids, : self.now + 1] = qpos[:, None, :2]
        self._extend(ids, self.now + 1)
        self._wait(ids)
        return qpos, qvel

    def spread(self) -> None:
        """What is asked of each row has been asked for a while."""
        self.left = (self.left * self.world.rng.random(len(self.left))).astype(int)

    def advance(self) -> None:
        """Time goes on by one control step; all paths grow by an arc when the last point has come within `seconds`."""
        self.now += 1
        if self.now == self.arc:
            self.now = 0
            self.points[:, : -self.arc] = self.points[:, self.arc :].copy()
            self._extend(np.arange(len(self.points)), self.points.shape[1] - self.arc)
        if self.config.jumps is not None:
            self.left -= 1
            due = np.flatnonzero(self.left <= 0)
            if len(due):
                way = JUMP * self.world.rng.random(len(due)) ** 0.5
                self.points[due] += (way[:, None] * direction(self.world.rng.uniform(-np.pi, np.pi, len(due))))[:, None]
                self._wait(due)

    def observe(self, body: BodyState, ids: Rows = ALL, out: np.ndarray | None = None) -> np.ndarray:
        """state | task (n, O) float32 of all rows or of rows ids."""
        obs, task = self.world.blank(body, out)
        points = self.points[ids, self.now + self.arc :: self.arc][:, : self.config.waypoints]
        task[:] = in_heading(points - body.pos[:, :1, :2], rotation.heading(body.quat)).reshape(task.shape)
        return obs

    def reward(self, body: BodyState) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Eq. 14: exp(-alpha_traj d) of the distance to where the root should be now."""
        reward = np.exp(-self.config.scale * length(body.pos[:, 0, :2] - self.target))
        return reward, {"path": reward}

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        """terminated: fallen, too far from the path, or not a number; truncated: never."""
        fallen, truncated = self.world.over(body)
        lost = length(body.pos[:, 0, :2] - self.target) > (self.config.far or np.inf)
        return fallen | lost, truncated

    def measure(self, body: BodyState) -> dict[str, np.ndarray]:
        """(N,) by name, for a `Scorecard`: the distance to where the root should be now."""
        return {"path_distance_m": length(body.pos[:, 0, :2] - self.target)}

    def hindsight(
        self, root: np.ndarray, heading: np.ndarray, ends: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Task observations (T, N, C) that a motion fulfilled, and where there is one (T, N): root (T, N, 2) metres and
        heading (T, N) radians of what was done; ends (T, N): the last step that step t may look ahead to.

        The waypoints are where the root was when they would have been due.
        """
        now, parts = np.arange(len(root))[:, None], []
        for number in range(1, self.config.waypoints + 1):
            ahead = np.broadcast_to(now + number * self.arc, heading.shape)
            parts.append(in_heading(later(root, ahead) - root, heading))
        return np.concatenate(parts, axis=-1), now + self.config.waypoints * self.arc <= ends

    def wish(self, c: np.ndarray) -> np.ndarray:
        """Where the root should be in a second (N, 2), metres in its heading frame, by task observations c (N, C): half
        the way to where it should be in two, so that half of a lead or lag is made up for at a time (docs/log.md)."""
        points = c.reshape(len(c), -1, 2)
        nearest = min(max(round(CATCH_UP * self.control_hz / self.arc), 1), points.shape[1])
        return points[:, nearest - 1] * (self.control_hz / (self.arc * nearest))

    def markers(self, row: int) -> list[Marker]:
        """Balls along the path, larger where a waypoint is, and a disc where the root should be now."""
        dots = [
            Marker(shape="ball", pos=(x, y, 0.03), radius=0.06 if i % 3 == 0 else 0.03, rgba=AHEAD)
            for i, (x, y) in enumerate(self.points[row, self.now :: max(self.arc // 3, 1)].tolist())
        ]
        x, y = self.target[row].tolist()
        return [Marker(shape="disc", pos=(x, y, 0.0), radius=0.2, rgba=GOAL), *dots[1:]]

    def finished(self, ids: np.ndarray, terminated: np.ndarray) -> None:
        """Nothing to learn from an episode."""

    def state_dict(self) -> dict:
        """Where in their arcs the paths are; paths themselves begin anew with their rows."""
        return {"now": self.now}

    def load_state_dict(self, state: dict) -> None:
        self.now = state["now"]

    def _wait(self, ids: np.ndarray) -> None:
        if self.config.jumps is not None:
            self.left[ids] = (self.world.rng.uniform(*self.config.jumps, len(ids)) * self.control_hz).round()

    def _extend(self, ids: np.ndarray, first: int) -> None:
        """Let the paths of rows ids go on from point first - 1, at their `angle` and `speed`, to the last point."""
        steps = self.points.shape[1] - first
        end = self.points[ids, first - 1]
        moves, self.angle[ids], self.speed[ids] = wander(
            self.config, self.angle[ids], self.speed[ids], steps, self.arc, self.control_hz, self.world.rng
        )
        self.points[ids, first:] = end[:, None] + moves


def wander(
    config: PathConfig,
    angle: np.ndarray,
    speed: np.ndarray,
    steps: int,
    arc: int,
    control_hz: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random smooth paths from the origin, first at angle (n,) and speed (n,): their points (n, steps, 2) at the
    control rate, and their last angle and speed. Turn rate and acceleration are constant for `arc` steps at a time."""
    n, arcs = len(angle), -(-steps // arc)
    low, high = config.speed
    most = config.acceleration * arc / control_hz
    knots = [speed]
    for change in rng.uniform(-most, most, (arcs, n)):
        knots.append((knots[-1] + change).clip(low, high))
    knots = np.stack(knots, axis=1)
    share = np.arange(1, arc + 1) / arc
    speeds = (knots[:, :-1, None] + share * np.diff(knots)[..., None]).reshape(n, -1)[:, :steps]
    turns = rng.uniform(-config.turn, config.turn, (n, arcs)).repeat(arc, axis=1)[:, :steps]
    angles = angle[:, None] + np.cumsum(turns, axis=1) / control_hz
    points = np.cumsum(speeds[..., None] * direction(angles), axis=1) / control_hz
    return points.astype(np.float32), angles[:, -1], speeds[:, -1]
