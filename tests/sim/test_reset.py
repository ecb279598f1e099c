"""reset.py: failure weights by hand, start noise."""

import numpy as np
import pytest

from kinetok.sim.reset import CELLS, StartWeights, perturb


def test_weights_by_hand():
    weights = StartWeights(3, rate=0.5, bounds=(0.1, 10.0))
    # clip 0, cell 2: two successes and a failure, net one success; clip 1, cell 7: a failure; nothing else
    weights.update(np.array([0, 0, 0, 1]), np.array([2, 2, 2, 7]), np.array([True, True, False, False]))
    expected = np.ones((3, CELLS))
    expected[0, 2], expected[1, 7] = 0.5, 2.0
    assert weights.values.tolist() == expected.tolist()
    often = np.array([0] * 9 + [1] * 9), np.array([2] * 9 + [7] * 9), np.array([True] * 9 + [False] * 9)
    weights.update(*often)
    expected[0, 2], expected[1, 7] = 0.1, 10.0
    assert weights.values.tolist() == expected.tolist()


def test_a_start_gets_its_weight_of_the_states_however_long_its_episodes_last():
    rng = np.random.default_rng(0)
    weights = StartWeights(3)
    weights.values[2] = 2.0
    lasts = np.array([3, 300, 30])[:, None] + np.array([0] * 7 + [300])  # steps of an episode by clip and cell
    clip, phase = weights.draw(512, rng)
    cell = phase.astype(int)
    left = lasts[clip, cell]
    seen = np.zeros((3, CELLS))
    for step in range(6000):
        weights.count(clip, cell)
        left -= 1
        over = np.flatnonzero(left == 0)
        clip[over], phase = weights.draw(len(over), rng)
        cell[over] = phase.astype(int)
        left[over] = lasts[clip[over], cell[over]]
        np.add.at(seen, (clip, cell), step >= 2000)
    share = seen / seen.sum()
    assert share.sum(1) == pytest.approx([0.25, 0.25, 0.5], abs=0.03)
    assert share == pytest.approx(weights.values / weights.values.sum(), abs=0.015)
    # Drawn alike, by episodes, the first cell of the first clip would have one state in a thousand.


def test_the_state_of_the_weights_repeats_their_draws():
    weights, again = StartWeights(4), StartWeights(4)
    weights.update(np.array([1, 2]), np.array([0, 5]), np.array([True, False]))
    clips, phases = weights.draw(50, np.random.default_rng(1))
    assert (phases.astype(int) < CELLS).all()
    weights.count(clips, phases.astype(int))
    again.load_state_dict(weights.state_dict())
    drawn = [one.draw(100, np.random.default_rng(2))[1] for one in (weights, again, StartWeights(4))]
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
