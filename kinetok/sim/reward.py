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


def tracking_errors(body: BodyState, reference: BodyState) -> dict[str, np.ndarray]:
    """Mean square errors (N,) by term. The squared angle is 3 - tr(R^T R_ref), equal to second order."""
    out = np.empty((len(ERRORS), len(body.pos)), dtype=np.float32)
    now = body.pos, body.mat, body.linear, body.angular
    _errors(*now, reference.pos, reference.mat, reference.linear, reference.angular, out)
    return dict(zip(ERRORS, out, strict=True))


@kernel
def _errors(pos, mat, linear, angular, pos_due, mat_due, linear_due, angular_due, out):
    bodies = pos.shape[1]
    for row in range(len(pos)):
        alike = mat[row, 0, 0, 0] * 0
        for b in range(bodies):
            for i in range(3):
                for j in range(3):
                    alike += mat[row, b, i, j] * mat_due[row, b, i, j]
        out[0, row] = _squares(pos, pos_due, row) / bodies
        out[1, row] = 3 - alike / bodies
        out[2, row] = _squares(linear, linear_due, row) / bodies
        out[3, row] = _squares(angular, angular_due, row) / bodies
        out[4, row] = (pos[row, 0, 2] - pos_due[row, 0, 2]) ** 2


@kernel
def _squares(now, due, row):
    """The sum of the squared differences of a row's vectors."""
    total = now[row, 0, 0] * 0
    for b in range(now.shape[1]):
        for i in range(3):
            total += (now[row, b, i] - due[row, b, i]) ** 2
    return total


def tracking_reward(errors: dict[str, np.ndarray], config: TrackingReward) -> dict[str, np.ndarray]:
    """Weighted terms (N,) by name; their sum, at most 1.2, is the reward."""
    terms = {}
    for name, error in errors.items():
        weight, coefficient = getattr(config, name)
        terms[name] = weight * np.exp(coefficient * error)
    return terms
