"""Where episodes start: reference-state initialisation, and clips drawn by how often they fail."""

import numpy as np


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
    qpos: np.ndarray, qvel: np.ndarray, scale: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Noisy copies of poses (n, nq) and velocities (n, nv): the start states of a robust tracker.

    scale is in radians for joints; velocities get ten times as much per second. The root keeps its place.
    """
    from_pose = qpos.copy()
    from_pose[:, 7:] += scale * rng.standard_normal(qpos[:, 7:].shape)  # MuJoCo renormalises the quaternions
    return from_pose, qvel + 10 * scale * rng.standard_normal(qvel.shape) * np.r_[
        [0.3] * 6, [1.0] * (qvel.shape[1] - 6)
    ]
