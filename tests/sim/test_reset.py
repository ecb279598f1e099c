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


def test_a_clip_gets_its_weight_of_the_states_however_long_its_episodes_last():
    rng = np.random.default_rng(0)
    weights = ClipWeights(3)
    weights.values = np.array([1.0, 1.0, 2.0])
    lasts = np.array([3, 300, 30])  # steps of an episode of each clip
    clip = weights.draw(64, rng)
    left = lasts[clip]
    seen = np.zeros(3)
    for step in range(6000):
        weights.count(clip)
        left -= 1
        over = np.flatnonzero(left == 0)
        clip[over] = weights.draw(len(over), rng)
        left[over] = lasts[clip[over]]
        seen += np.bincount(clip, minlength=3) * (step >= 2000)
    assert seen / seen.sum() == pytest.approx([0.25, 0.25, 0.5], abs=0.03)
    # Drawn alike, by episodes, the first would have one state in a hundred.


def test_the_state_of_the_weights_repeats_their_draws():
    weights, again = ClipWeights(4), ClipWeights(4)
    weights.update(np.array([1, 2]), np.array([True, False]))
    weights.count(weights.draw(50, np.random.default_rng(1)))
    again.load_state_dict(weights.state_dict())
    drawn = [one.draw(100, np.random.default_rng(2)) for one in (weights, again, ClipWeights(4))]
    assert (drawn[0] == drawn[1]).all() and (drawn[0] != drawn[2]).any()


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
