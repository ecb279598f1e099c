"""reset.py: failure weights by hand, start noise."""

import numpy as np
import pytest

from kinetok.sim.reset import ClipWeights, perturb


def test_weights_by_hand():
    weights = ClipWeights(3, rate=0.5, bounds=(0.1, 10.0))
    # clip 0: two successes and a failure, net one success; clip 1: a failure; clip 2: nothing
    weights.update(np.array([0, 0, 0, 1]), np.array([True, True, False, False]))
    assert weights.values.tolist() == [0.5, 2.0, 1.0]
    weights.update(np.array([0] * 9 + [1] * 9), np.array([True] * 9 + [False] * 9))
    assert weights.values.tolist() == [0.1, 10.0, 1.0]


def test_perturb_leaves_the_root_and_its_arguments_alone():
    qpos, qvel = np.zeros((4000, 12)), np.zeros((4000, 10))
    noisy, fast = perturb(qpos, qvel, 0.05, np.random.default_rng(0))
    assert (qpos == 0).all() and (qvel == 0).all()
    assert (noisy[:, :7] == 0).all()
    assert noisy[:, 7:].std() == pytest.approx(0.05, rel=0.05)
    assert fast[:, 6:].std() == pytest.approx(0.5, rel=0.05)
    assert fast[:, :6].std() == pytest.approx(0.15, rel=0.05)
