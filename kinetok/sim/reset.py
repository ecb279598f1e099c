"""Where episodes start: reference-state initialisation, and clips drawn by how often they fail."""

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character


class ClipWeights:
    """Failure-weighted sampling (GPC eq. 9): w <- w * gamma**K on success, w / gamma**K on failure.

    gamma**K is `rate`; weights stay within `bounds` so that no clip is forgotten or takes all.
    """

    def __init__(self, clips: int, rate: float = 0.98, bounds: tuple[float, float] = (0.1, 10.0)):
        self.values = np.ones(clips)
        self.rate, self.bounds = rate, bounds

    def update(self, clips: np.ndarray, success: np.ndarray) -> None:
        """Finished episodes: their clips (E,) and whether each succeeded (E,)."""
        count = np.bincount(clips, np.where(success, 1.0, -1.0), len(self.values))
        self.values = np.clip(self.values * self.rate**count, *self.bounds)


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
