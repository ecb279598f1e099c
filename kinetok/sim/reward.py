"""Reward terms as pure functions: body state and reference in, one number per row out.

GPC eq. 8 and table 5: r = sum_k w_k exp(c_k * e_k) with e_k a mean square error over the bodies.
"""

from dataclasses import dataclass

import numpy as np

from kinetok.sim.batch import BodyState


@dataclass(frozen=True, kw_only=True)
class TrackingReward:
    """(weight, coefficient) of each term: position, rotation, linear and angular velocity, root height."""

    position: tuple[float, float] = (0.5, -100.0)
    rotation: tuple[float, float] = (0.3, -5.0)
    linear: tuple[float, float] = (0.1, -0.5)
    angular: tuple[float, float] = (0.1, -0.1)
    height: tuple[float, float] = (0.2, -100.0)


def tracking_errors(body: BodyState, reference: BodyState) -> dict[str, np.ndarray]:
    """Mean square errors (N,) by term. The squared angle is 3 - tr(R^T R_ref), equal to second order."""
    bodies = body.mat.shape[1]

    def square(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        difference = a - b
        return np.einsum("nbi,nbi->n", difference, difference) / bodies

    return {
        "position": square(body.pos, reference.pos),
        "rotation": 3 - np.einsum("nbij,nbij->n", body.mat, reference.mat) / bodies,
        "linear": square(body.linear, reference.linear),
        "angular": square(body.angular, reference.angular),
        "height": (body.pos[:, 0, 2] - reference.pos[:, 0, 2]) ** 2,
    }


def tracking_reward(errors: dict[str, np.ndarray], config: TrackingReward) -> dict[str, np.ndarray]:
    """Weighted terms (N,) by name; their sum, at most 1.2, is the reward."""
    terms = {}
    for name, error in errors.items():
        weight, coefficient = getattr(config, name)
        terms[name] = weight * np.exp(coefficient * error)
    return terms
