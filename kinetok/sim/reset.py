"""Where episodes start: reference-state initialisation, and clips drawn by how often they fail."""

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character

FADE = 0.998  # per control step: what was seen 500 steps ago counts a third
TYPICAL = 100.0  # steps an episode is taken to last before a clip has shown how long its own do


class ClipWeights:
    """Failure-weighted sampling (GPC eq. 9): w <- w * gamma**K on success, w / gamma**K on failure.

    gamma**K is `rate`; weights stay within `bounds` so that no clip is forgotten or takes all. A clip's weight is its
    share of the *states*, not of the episodes: episodes of a clip that fails after half a second are drawn more often
    than those of one that goes on for thirty, else what cannot be followed yet is hardly seen and never learned.
    """

    def __init__(self, clips: int, rate: float = 0.98, bounds: tuple[float, float] = (0.3, 3.0)):
        self.values = np.ones(clips)
        self.rate, self.bounds = rate, bounds
        self._started = np.full(clips, 1.0)
        self._seen = np.full(clips, TYPICAL)

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Clips (count,) of new episodes."""
        edges = np.cumsum(self.values * (self._started + 1) / (self._seen + TYPICAL))
        clips = np.searchsorted(edges, rng.random(count) * edges[-1], side="right").clip(max=len(edges) - 1)
        self._started += np.bincount(clips, minlength=len(edges))
        return clips

    def count(self, clips: np.ndarray) -> None:
        """One control step of rows that follow `clips` (N,)."""
        self._started *= FADE
        self._seen = FADE * self._seen + np.bincount(clips, minlength=len(self._seen))

    def update(self, clips: np.ndarray, success: np.ndarray) -> None:
        """Finished episodes: their clips (E,) and whether each succeeded (E,)."""
        count = np.bincount(clips, np.where(success, 1.0, -1.0), len(self.values))
        self.values = np.clip(self.values * self.rate**count, *self.bounds)

    def state_dict(self) -> dict:
        return {"weights": self.values.tolist(), "started": self._started.tolist(), "seen": self._seen.tolist()}

    def load_state_dict(self, state: dict) -> None:
        self.values = np.array(state["weights"])
        self._started, self._seen = np.array(state["started"]), np.array(state["seen"])


def perturb(
    body: Character, qpos: np.ndarray, qvel: np.ndarray, scale: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Noisy copies of poses (n, nq) and velocities (n, nv): the start states of a robust tracker.

    Every joint turns by `scale` radians about each of its axes, a ball joint about all three; joint velocities
    change by ten times as much per second, the root's by three times. The root keeps its place.
    """
    noisy = qpos.copy()
    hinges = body.hinge[:, 0]
    noisy[:, hinges] += scale * rng.standard_normal((len(qpos), len(hinges)))
    balls = body.ball[:, :1] + np.arange(4)
    turn = rotation.from_rotvec(scale * rng.standard_normal((len(qpos), len(balls), 3)))
    noisy[:, balls] = rotation.multiply(noisy[:, balls], turn)
    spread = np.full(qvel.shape[1], 10 * scale)
    spread[:6] = 3 * scale
    return noisy, qvel + spread * rng.standard_normal(qvel.shape)
