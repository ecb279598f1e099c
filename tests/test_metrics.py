"""metrics.py: values worked out by hand, the laws each number obeys, messages."""

import itertools

import numpy as np
import pytest

from kinetok import metrics

ZEROS = np.zeros((4, 2, 3))


def test_mpjpe_by_hand():
    pos = ZEROS.copy()
    pos[:, 0] = (0.3, 0.0, 0.4)  # one of two bodies is 0.5 m off: 250 mm on average
    assert metrics.mpjpe_mm(pos, ZEROS) == pytest.approx(250.0)
    assert metrics.mpjpe_mm(pos + 1.0, pos, local=True) == pytest.approx(0.0, abs=1e-9)  # from the root, drift is none
    assert metrics.mpjpe_mm(pos, ZEROS, local=True) == pytest.approx(250.0)  # the other body, as the root was moved


def test_apd_by_hand_and_against_the_definition():
    still = np.zeros((3, 5, 2))
    assert metrics.apd(still) == 0.0
    still[1] += (3.0, 4.0)  # pairs: 5, 0, 5
    assert metrics.apd(still) == pytest.approx(10.0 / 3.0)
    x = np.random.default_rng(0).normal(size=(6, 7, 4))
    pairs = [np.linalg.norm(a - b, axis=-1).mean() for a, b in itertools.combinations(x, 2)]
    assert metrics.apd(x) == pytest.approx(np.mean(pairs))
    assert metrics.apd(x + 1e6) == pytest.approx(np.mean(pairs))


def test_acceleration_of_free_fall():
    t = np.arange(10)[:, None, None] / 30
    assert metrics.mean_acceleration(-0.5 * 9.81 * t**2 * [0, 0, 1], 30) == pytest.approx(9.81)


def minimum_jerk(fps, duration, reach):
    s = np.linspace(0.0, 1.0, round(fps * duration) + 1)[:, None, None]
    return reach * (10 * s**3 - 15 * s**4 + 6 * s**5) * [1.0, 0.0, 0.0]


@pytest.mark.parametrize(("duration", "reach"), [(0.4, 1.0), (0.4, 0.1), (2.0, 1.0)])
def test_jerk_of_a_minimum_jerk_reach(duration, reach):
    # integral of jerk^2 = 720 A^2 / D^5, v_peak = 1.875 A / D: eta = 720 / 1.875^2 = 204.8
    pos = minimum_jerk(1000, duration, reach)
    assert metrics.normalized_jerk(pos, 1000, window=duration) == pytest.approx(204.8, rel=0.02)


def test_jerk_slides_windows_and_leaves_out_rest():
    fps, reach = 100, minimum_jerk(100, 0.4, 1.0)
    straight = np.linspace(0, 1, 101)[:, None, None] * [1.0, 0.0, 0.0]
    assert metrics.normalized_jerk(straight, fps) == pytest.approx(0.0, abs=1e-6)
    resting = np.concatenate([reach, np.zeros_like(reach)], axis=1)
    assert metrics.normalized_jerk(resting, fps) == pytest.approx(metrics.normalized_jerk(reach, fps))
    assert np.isnan(metrics.normalized_jerk(np.zeros((100, 2, 3)), fps))


def test_token_statistics_by_hand():
    tokens = np.array([[0, 3], [0, 2], [0, 1], [0, 0]])
    np.testing.assert_allclose(metrics.utilisation(tokens, 4), [0.25, 1.0])
    np.testing.assert_allclose(metrics.perplexity(tokens, 4), [1.0, 4.0])
    np.testing.assert_allclose(metrics.perplexity([[0], [0], [0], [1]], 9), [4 / 3**0.75])


def test_foot_skate_counts_only_feet_on_the_ground():
    pos = np.zeros((3, 2, 3))
    pos[:, 0, 0] = [0.0, 0.01, 0.02]  # sliding at 0.3 m/s
    pos[:, 1] = [(0, 0, 0.0), (5, 0, 0.5), (9, 0, 0.5)]  # in the air in one frame of every step
    assert metrics.foot_skate(pos, 0.05, 30) == pytest.approx(0.3)
    assert np.isnan(metrics.foot_skate(pos + 1.0, 0.05, 30))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: metrics.mpjpe_mm(np.zeros((4, 3)), ZEROS),
            r"pos must be \(T, B, 3\) and not empty, not \(4, 3\)",
        ),
        (lambda: metrics.mpjpe_mm(ZEROS, ZEROS[1:]), "they must be alike"),
        (
            lambda: metrics.apd(np.zeros((1, 5, 2))),
            "holds one rollout; a pairwise distance needs at least two",
        ),
        (lambda: metrics.mean_acceleration(ZEROS[:2], 30), "pos has 2 frames; at least 3 are needed"),
        (lambda: metrics.normalized_jerk(ZEROS, 30), "pos has 4 frames; at least 13 are needed"),
        (lambda: metrics.normalized_jerk(ZEROS, 5), "holds 2 steps at 5 fps; jerk needs at least 3"),
        (lambda: metrics.utilisation([[4]], 4), r"tokens span 4\.\.4; the vocabulary has 4 ids"),
        (lambda: metrics.perplexity([[0.5]], 4), r"tokens must be \(N, S\) integers and not empty"),
    ],
)
def test_messages(call, message):
    with pytest.raises(ValueError, match=message):
        call()
