"""Reward terms as pure functions: body state and reference in, one number per row out.

GPC eq. 8 and table 5: r = sum_k w_k exp(c_k * e_k) with e_k a mean square error over the bodies.
"""

from dataclasses import dataclass

import numpy as np

from kinetok.sim.batch import BodyState
from kinetok.sim.kernels import kernel


@dataclass(frozen=True, kw_only=True)
class TrackingReward:
    """(weight, coefficient) of each term: position, rotation, linear and angular velocity, root height."""

    position: tuple[float, float] = (0.5, -100.0)
    rotation: tuple[float, float] = (0.3, -5.0)
    linear: tuple[float, float] = (0.1, -0.5)
    angular: tuple[float, float] = (0.1, -0.1)
    height: tuple[float, float] = (0.2, -100.0)


ERRORS = ("position", "rotation", "linear", "angular", "height")


def tracking_errors(body: BodyState, reference: BodyState, due: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Mean square errors (N,) by term. The squared angle is 3 - tr(R^T R_ref), equal to second order.

    due (N,): the rows of `reference` in which the body's should be; its own, where not given.
    """
    out = np.empty((len(ERRORS), len(body.pos)), dtype=np.float32)
    due = np.arange(len(body.pos)) if due is None else due
    _errors(*body.moving, *reference.moving, due, out)
    return dict(zip(ERRORS, out, strict=True))


@kernel
def _errors(pos, mat, linear, angular, pos_due, mat_due, linear_due, angular_due, due, out):
    bodies = pos.shape[1]
    for row in range(len(pos)):
        at, alike = due[row], mat[row, 0, 0, 0] * 0
        for b in range(bodies):
            for i in range(3):
                for j in range(3):
                    alike += mat[row, b, i, j] * mat_due[at, b, i, j]
        out[0, row] = _squares(pos[row], pos_due[at]) / bodies
        out[1, row] = 3 - alike / bodies
        out[2, row] = _squares(linear[row], linear_due[at]) / bodies
        out[3, row] = _squares(angular[row], angular_due[at]) / bodies
        out[4, row] = (pos[row, 0, 2] - pos_due[at, 0, 2]) ** 2


@kernel
def _squares(now, due):
    """The sum of the squared differences of vectors (B, 3)."""
    total = now[0, 0] * 0
    for b in range(len(now)):
        for i in range(3):
            total += (now[b, i] - due[b, i]) ** 2
    return total


def tracking_reward(errors: dict[str, np.ndarray], config: TrackingReward) -> dict[str, np.ndarray]:
    """Weighted terms (N,) by name; their sum, at most 1.2, is the reward."""
    terms = {}
    for name, error in errors.items():
        weight, coefficient = getattr(config, name)
        terms[name] = weight * np.exp(coefficient * error)
    return terms
