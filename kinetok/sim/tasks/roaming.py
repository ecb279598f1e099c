"""Roaming: tracking that goes over from one clip to another, and episodes that begin as if they had.

    task = Roaming(TrackingConfig(), table, rows=256, transitions=0.3, rng=rng)
    step = env.step(action)
    task.land(env, step.obs)                        # rows that change their clip go on in the new one

Physics on a flat floor does not change when the world is shifted and turned, so a row goes on in another clip by
having its own root moved to a frame of that clip which it resembles already (`likeness`). A tracker that knows only
its clip's own states falls after most such changes; `Arriving` shows them to it: a share of its episodes begins in
states of other clips.
"""

from functools import cached_property

import numpy as np

from kinetok import rotation
from kinetok.sim import observe
from kinetok.sim.batch import BodyState
from kinetok.sim.env import Env
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking, TrackingConfig

REACH = 0.25  # metres of `likeness`; walk to run, or the end of a jump to standing, is about 0.2
GRACE = 0.3  # seconds for the body to come over to a reference that jumped
GLANCE = 0.1  # seconds; a velocity difference counts as the distance it makes in this time


class Graceful(Tracking):
    """Tracking whose rows may have `grace` (rows,) steps in which no error is a failure, only what is not a number."""

    def __init__(self, config: TrackingConfig, table: ReferenceTable, *, rows: int):
        super().__init__(config, table, rows=rows)
        self.grace = np.zeros(rows, int)

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        self.grace[ids] = 0
        return super().start(ids, rng)

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        terminated, over = super().over(body)
        terminated &= (self.grace == 0) | ~np.isfinite(self.offset).all((1, 2))
        self.grace = np.maximum(self.grace - 1, 0)
        return terminated, over

    def enter(self, ids: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Let rows ids go on from table frame `frame` (n,), with grace; its place (n, 2) and heading (n,)."""
        self.place(ids, np.searchsorted(self.table.first, frame, side="right") - 1, frame)
        self.grace[ids] = round(GRACE * self.table.control_hz)
        return self.table.root[frame, :2], self.table.heading[frame]


class Arriving(Graceful):
    """Tracking in which `share` of the episodes begin in a state of one of the clips of `others`.

    Each of those is drawn as often as any other, and the row goes on in the likest frame of the table's clips. States
    that resemble none within `reach` are left out, of a clip that is like no other all of them.
    """

    def __init__(
        self,
        config: TrackingConfig,
        table: ReferenceTable,
        others: ReferenceTable,
        *,
        rows: int,
        share: float,
        reach: float,
    ):
        super().__init__(config, table, rows=rows)
        own = Entries(table, max(config.future))
        chances, sources, frames = [], [], []
        for first, cycle in zip(others.first, others.cycle, strict=True):
            states = np.arange(first, first + cycle)
            squares = own.squares(likeness(others.body.rows(states)))
            near = squares.min(1) < reach**2
            sources.append(states[near])
            frames.append(own.frames[squares.argmin(1)[near]])
            chances.append(np.full(near.sum(), 1 / max(near.sum(), 1)))
        self.sources, self.frames = np.concatenate(sources), np.concatenate(frames)
        self._edges = np.cumsum(np.concatenate(chances))
        self.others, self.share = others, share if len(self.sources) else 0.0

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        qpos, qvel = super().start(ids, rng)
        rows = np.flatnonzero(rng.random(len(ids)) < self.share)
        if len(rows):
            drawn = np.searchsorted(self._edges, rng.random(len(rows)) * self._edges[-1], side="right")
            drawn = drawn.clip(max=len(self.sources) - 1)
            place = self.enter(ids[rows], self.frames[drawn])
            source = self.sources[drawn]
            qpos[rows], qvel[rows] = moved(self.others.qpos[source], self.others.qvel[source], *place)
        return qpos, qvel


class Entries:
    """Where a table's clips may be entered: at any phase of the first cycle, or where at least `tail` steps or half of
    the clip are left.

    frames (E,); owner (E,): their clips; edges (K,): each clip's first entry.
    """

    def __init__(self, table: ReferenceTable, tail: int):
        span = table.last - table.first
        latest = np.where(span > table.cycle, table.cycle - 1, np.maximum(span - tail, span // 2))
        self.frames = np.concatenate([np.arange(a, a + b + 1) for a, b in zip(table.first, latest, strict=True)])
        self.edges = np.cumsum(latest + 1) - (latest + 1)
        self.owner = np.repeat(np.arange(len(table.names)), latest + 1)
        self._table = table

    @cached_property
    def _features(self) -> np.ndarray:
        return likeness(self._table.body.rows(self.frames))

    @cached_property
    def _lengths(self) -> np.ndarray:
        return (self._features**2).sum(1)

    def squares(self, features: np.ndarray) -> np.ndarray:
        """Squared distances (N, E) of `likeness` features (N, F) from every entry, square metres."""
        return (features**2).sum(1)[:, None] + self._lengths - 2 * features @ self._features.T


class Roaming(Graceful):
    """Tracking that goes on in another clip, `transitions` times per second on average and where a clip ends.

    `over` leaves the frame at which each row is to go on in `landing` (rows,), -1 for most; `land` moves it there.
    A clip's last `tail` steps, in which the window ahead begins to stand still, are left at a moment drawn
    uniformly. A row whose clip is over and that resembles no frame within `reach` goes on in the likest frame of all
    within `reach_at_end`, and without one it is truncated, as in Tracking. After a landing no error is a failure for
    GRACE; one that is still too large then is.
    """

    def __init__(
        self,
        config: TrackingConfig,
        table: ReferenceTable,
        *,
        rows: int,
        transitions: float,
        rng: np.random.Generator,
        reach: float = REACH,
        reach_at_end: float = REACH,
    ):
        super().__init__(config, table, rows=rows)
        self.landing = np.full(rows, -1)
        self.tail, self._rng, self._reach, self._reach_at_end = max(config.future), rng, reach, reach_at_end
        self._chance = transitions / table.control_hz
        self._entries = Entries(table, self.tail)

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        self.landing[ids] = -1
        return super().start(ids, rng)

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        terminated, over = super().over(body)
        left = self.table.last[self.clip] - self.frame
        chance = np.where(left <= self.tail, 1 / np.maximum(left, 1), self._chance)
        seeking = np.flatnonzero((self._rng.random(len(left)) < chance) & ~terminated)
        self.landing[:] = -1
        if len(seeking):
            self.landing[seeking] = self._nearest(body.rows(seeking), seeking, left[seeking])
        return terminated, over & (self.landing < 0)

    def state_dict(self) -> dict:
        return super().state_dict() | {"rng": self._rng.bit_generator.state}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self._rng.bit_generator.state = state["rng"]

    def land(self, env: Env, obs: np.ndarray) -> None:
        """Move the rows of env that `landing` names into their new clips; obs (N, O) is renewed in place."""
        ids = np.flatnonzero(self.landing >= 0)
        if not len(ids):
            return
        place = self.enter(ids, self.landing[ids])
        self.landing[ids] = -1
        env.sim.set_state(ids, *moved(env.sim.qpos[ids], env.sim.qvel[ids], *place))
        obs[ids] = self.observe(env.sim.state(ids), ids)

    def _nearest(self, body: BodyState, ids: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Where rows ids with `left` (k,) steps of their clip may go on: frames (k,), or -1.

        The likest frame in a random one of the clips within reach; where the clip is over and none is within reach,
        the likest of all within reach_at_end. Of its own clip, only in the tail, and only what is a tail or more ago:
        the frames just behind are always the likest, and the motion would stutter.
        """
        entries = self._entries
        squares = entries.squares(likeness(body))
        latest = np.where(left <= self.tail, self.frame[ids] - self.tail, -1)
        squares[(entries.owner == self.clip[ids, None]) & (entries.frames > latest[:, None])] = np.inf
        best = np.minimum.reduceat(squares, entries.edges, axis=1)
        near = best < self._reach**2
        chosen = np.where(near, self._rng.random(near.shape), -1).argmax(1)
        jumps = ~near.any(1) & (left <= 0) & (best.min(1) < self._reach_at_end**2)
        chosen[jumps] = best[jumps].argmin(1)
        stop = np.append(entries.edges[1:], len(entries.frames))
        frame = np.full(len(ids), -1)
        for row in np.flatnonzero(near.any(1) | jumps):
            first = entries.edges[chosen[row]]
            frame[row] = entries.frames[first + squares[row, first : stop[chosen[row]]].argmin()]
        return frame


def likeness(body: BodyState) -> np.ndarray:
    """Features (N, F) whose distance is that of two states in metres, blind to place and heading: root height,
    and the root mean squares over bodies of the relative positions and of GLANCE times the velocities."""
    state, bodies = observe.state_features(body), body.pos.shape[1]
    pos = state[:, 1 : 1 + (bodies - 1) * 3]
    linear = state[:, 1 + (bodies - 1) * 3 + bodies * 6 : 1 + (bodies - 1) * 3 + bodies * 9]
    return np.concatenate([state[:, :1], pos / bodies**0.5, linear * (GLANCE / bodies**0.5)], axis=1)


def moved(qpos: np.ndarray, qvel: np.ndarray, xy: np.ndarray, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same states (n, nq), (n, nv) with the root at xy (n, 2) and turned to heading (n,).

    Physics cannot tell, but for the scene's friction pyramid, whose corners keep their directions in the world.

    Of a free joint's velocity the linear part is in the world frame and turns along, the angular part is local.
    """
    qpos, qvel = qpos.copy(), qvel.copy()
    angle = heading - rotation.heading(qpos[:, 3:7])
    qpos[:, :2] = xy
    qpos[:, 3:7] = rotation.multiply(rotation.about_z(angle), qpos[:, 3:7])
    qvel[:, :3] = rotation.turn(qvel[:, :3], np.cos(angle), np.sin(angle))
    return qpos, qvel
