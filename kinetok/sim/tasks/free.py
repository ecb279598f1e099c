"""Free: the character moves by itself. Nothing is asked of it, nothing is rewarded, no fall ends an episode.

    task = Free(character, qpos, qvel, rows=64)                     # start states drawn at random
    task = Free(character, qpos, qvel, rows=64, starts=np.arange(64))   # row i begins in state starts[i]

The world in which a prior is sampled and measured. The observation is proprioception alone
(observe.state_features); a body state that is not a number is the only failure. It knows no clip.
"""

import numpy as np

from kinetok.motion.character import Character
from kinetok.sim import observe
from kinetok.sim.batch import ALL, BodyState, Rows


class Free:
    """`rows` worlds that begin in the states qpos (K, nq), qvel (K, nv).

    starts (rows,) pins each row to one state; without it every episode draws one. `drawn` (rows,) says which it was.
    """

    def __init__(
        self,
        character: Character,
        qpos: np.ndarray,
        qvel: np.ndarray,
        *,
        rows: int,
        starts: np.ndarray | None = None,
    ):
        expected = (len(qpos), character.nq), (len(qpos), character.nv)
        if (qpos.shape, qvel.shape) != expected or not len(qpos):
            raise ValueError(
                f"start states have shapes {qpos.shape} and {qvel.shape}; {character.name!r} needs "
                f"(K, {character.nq}) and (K, {character.nv}) with the same K > 0"
            )
        if starts is not None and (len(starts) != rows or np.min(starts) < 0 or np.max(starts) >= len(qpos)):
            raise ValueError(f"starts must name one of the {len(qpos)} start states for each of {rows} rows: {starts}")
        self.character, self.qpos, self.qvel, self.starts = character, qpos, qvel, starts
        self.drawn = np.zeros(rows, dtype=int)
        self.obs_size = observe.state_size(len(character.body_names))

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The pinned start states of rows ids, or random ones."""
        self.drawn[ids] = rng.integers(len(self.qpos), size=len(ids)) if self.starts is None else self.starts[ids]
        return self.qpos[self.drawn[ids]], self.qvel[self.drawn[ids]]

    def spread(self) -> None:
        """Nothing is asked of a row."""

    def advance(self) -> None:
        """Nothing moves but the character."""

    def observe(self, body: BodyState, ids: Rows = ALL, out: np.ndarray | None = None) -> np.ndarray:
        """Proprioception (n, O) float32 of the rows in body."""
        return observe.state_features(body, out)

    def reward(self, body: BodyState) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Zeros (N,) and no terms."""
        return np.zeros(len(body.pos), dtype=np.float32), {}

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        """terminated: the state is not a number. truncated: never; the time limit is the environment's."""
        numbers = np.concatenate([body.pos, body.linear], axis=1)
        fine = np.isfinite(numbers.reshape(len(numbers), -1)).all(axis=1)
        return np.logical_not(fine), np.zeros(len(numbers), dtype=bool)

    def finished(self, ids: np.ndarray, terminated: np.ndarray) -> None:
        """Nothing to learn from an episode."""

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, state: dict) -> None:
        """There is no state."""
