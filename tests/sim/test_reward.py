"""reward.py: GPC eq. 8 by hand."""

import numpy as np
import pytest

from kinetok.sim.batch import BodyState
from kinetok.sim.reward import TrackingReward, tracking_errors, tracking_reward


def body(pos=0.0, turn=0.0, linear=0.0, angular=0.0) -> BodyState:
    """Two bodies; the second is moved by pos (3,) and turned by `turn` about z, both have the velocities given."""
    cos, sin = np.cos(turn), np.sin(turn)
    mat = np.tile(np.eye(3, dtype=np.float32), (1, 2, 1, 1))
    mat[0, 1, :2, :2] = [[cos, -sin], [sin, cos]]
    p = np.zeros((1, 2, 3), dtype=np.float32)
    p[0, 1] = pos
    ones = np.ones((1, 2, 3), dtype=np.float32)
    quat = np.array([[1, 0, 0, 0]], dtype=np.float32)
    return BodyState(pos=p, mat=mat, linear=linear * ones, angular=angular * ones, quat=quat)


def test_errors_by_hand():
    errors = tracking_errors(body([0.3, 0.0, 0.4], np.pi / 3, 2.0, -1.0), body())
    assert errors["position"] == pytest.approx(0.25 / 2)  # mean over two bodies of |d|^2
    assert errors["rotation"] == pytest.approx((2 - 2 * np.cos(np.pi / 3)) / 2)  # 3 - tr = 2 - 2 cos
    assert errors["linear"] == pytest.approx(3 * 4.0)
    assert errors["angular"] == pytest.approx(3 * 1.0)
    assert errors["height"] == pytest.approx(0.0)  # of the root, which stands still


def test_height_is_the_roots():
    low = body()
    low.pos[0, 0, 2] = 0.2
    assert tracking_errors(low, body())["height"] == pytest.approx(0.04)


def test_small_angles_are_squared_angles():
    assert tracking_errors(body(turn=0.02), body())["rotation"] == pytest.approx(0.02**2 / 2, rel=1e-2)


def test_reward_by_hand():
    errors = {"position": np.array([0.01]), "rotation": np.array([0.2]), "linear": np.array([2.0])}
    errors |= {"angular": np.array([10.0]), "height": np.array([0.0])}
    terms = tracking_reward(errors, TrackingReward())
    assert {k: float(v[0]) for k, v in terms.items()} == pytest.approx(
        {
            "position": 0.5 * np.exp(-1.0),
            "rotation": 0.3 * np.exp(-1.0),
            "linear": 0.1 * np.exp(-1.0),
            "angular": 0.1 * np.exp(-1.0),
            "height": 0.2,
        }
    )


def test_the_best_reward_is_one_point_two():
    terms = tracking_reward(tracking_errors(body(), body()), TrackingReward())
    assert sum(terms.values()) == pytest.approx(1.2)
