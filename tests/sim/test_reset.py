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


def test_perturb_turns_every_joint_by_the_scale_and_leaves_the_root_and_its_arguments_alone(humanoid):
    qpos = np.repeat(humanoid.model.qpos0[None], 4000, axis=0)
    qvel = np.zeros((4000, humanoid.nv))
    noisy, fast = perturb(humanoid, qpos, qvel, 0.05, np.random.default_rng(0))
    assert (qpos == humanoid.model.qpos0).all() and (qvel == 0).all()
    assert (noisy[:, :7] == qpos[:, :7]).all()
    # The rest pose has zero angles, so the PD targets of the noisy pose are the noise itself.
    assert humanoid.pose_to_ctrl(noisy).std(0) == pytest.approx(0.05, rel=0.08)
    assert fast[:, 6:].std() == pytest.approx(0.5, rel=0.05)
    assert fast[:, :6].std() == pytest.approx(0.15, rel=0.05)
