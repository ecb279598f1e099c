"""Matching: tracking that goes on, a few times a second, where the recorded motion does what is wished for.

    task = Matching(TrackingConfig(), table, rows=256, rng=rng)
    task.wish[:] = (1.0, 0.5)                       # metres, in a second from now, seen from the root: ahead, left
    step = env.step(action)
    task.land(env, step.obs)

Motion matching (Clavet 2016, "Motion matching and the road to next-gen animation") as a demonstrator: of all frames
that resemble the body, a row goes on in the one whose own next second comes nearest to the wish, unless the clip it is
in does as well. The tracker that follows shows what tokens such a wish takes.

A row that something else drives (`driven`) need not stay near what it follows: what it follows is found anew wherever
the body is, and only a fall ends it.
"""

import numpy as np

from kinetok import rotation
from kinetok.sim.batch import BodyState
from kinetok.sim.tasks.roaming import Roaming, likeness
from kinetok.sim.tasks.tracking import ReferenceTable, TrackingConfig

SEARCHES = 5.0  # a second, each row at moments of its own
REACH = 0.15  # metres of `likeness`: frames of one gait, of which a varied one has many, are nearer than that
LIKENESS = 4.0  # weight of the squared likeness, against the squared metres by which a wish is missed
MARGIN = 0.02  # square metres by which another frame must be better
DRIVEN_REACH = 0.6  # metres of `likeness` for a driven row
FALLEN = 0.5  # metres of the root


class Matching(Roaming):
    """wish (rows, 2): where the root should be in a second, in metres in its heading frame. driven (rows,) bool."""

    def __init__(
        self,
        config: TrackingConfig,
        table: ReferenceTable,
        *,
        rows: int,
        rng: np.random.Generator,
        reach: float = REACH,
    ):
        super().__init__(config, table, rows=rows, transitions=SEARCHES, rng=rng, reach=reach, reach_at_end=2 * reach)
        self.wish = np.zeros((rows, 2), np.float32)
        self.driven = np.zeros(rows, bool)
        last = np.repeat(table.last, table.last - table.first + 1)
        ahead = np.arange(len(last)) + table.control_hz
        step = np.concatenate(
            [table.root[np.minimum(ahead, last), :2] - table.root[:, :2], np.zeros((len(last), 1))], 1
        )
        self.second = rotation.turn(step, np.cos(table.heading), -np.sin(table.heading))[:, :2].astype(np.float32)
        self._whole = ahead <= last

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        self.grace[self.driven] = 2  # no error is a failure
        terminated, over = super().over(body)
        terminated |= self.driven & (body.pos[:, 0, 2] < FALLEN)
        self.landing[terminated] = -1
        return terminated, over & ~terminated

    def _nearest(self, body: BodyState, ids: np.ndarray, left: np.ndarray) -> np.ndarray:
        entries, seen = self._entries, likeness(body)
        squares = entries.squares(seen)
        missed = self.second[entries.frames] - self.wish[ids][:, None]
        cost = LIKENESS * squares + np.einsum("nek,nek->ne", missed, missed)
        beside = np.abs(entries.frames - self.frame[ids][:, None]) < self.tail
        near = np.where(left <= 0, self._reach_at_end, self._reach)
        near = np.maximum(near, np.where(self.driven[ids], DRIVEN_REACH, 0.0))[:, None] ** 2
        cost[(squares > near) | ~self._whole[entries.frames] | (beside & (entries.owner == self.clip[ids, None]))] = (
            np.inf
        )
        best = cost.argmin(1)
        apart = seen - likeness(self.table.body.rows(self.frame[ids]))
        stay = ((self.second[self.frame[ids]] - self.wish[ids]) ** 2).sum(1) + LIKENESS * (apart**2).sum(1)
        stay[left <= self.tail] = np.inf
        lowest = cost[np.arange(len(ids)), best]
        return np.where(np.isfinite(lowest) & (lowest < stay - MARGIN), entries.frames[best], -1)
