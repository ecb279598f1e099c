"""controller.py: the loop is closed as the pieces say, and chance comes from the seed alone."""

import numpy as np
import pytest
import torch
from made import make_prior

from kinetok.gpt.controller import PriorController, roll
from kinetok.gpt.sample import sample


@pytest.fixture(scope="module")
def prior(tmp_path_factory, table):
    return make_prior(tmp_path_factory.mktemp("models"), table)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_a_step_is_sample_then_decode(prior):
    state = torch.randn(5, prior.gpt.config.state_dim)
    action, tokens = PriorController(prior, top_p=0.8, temperature=0.7, generator=generator()).act(state)
    expected = sample(prior.gpt, state, generator=generator(), top_p=0.8, temperature=0.7)
    assert torch.equal(tokens, expected) and action.shape == (5, prior.character.nu)
    assert torch.equal(action, prior.tokenizer.decode(prior.tokenizer.layout.to_codes(tokens), state))


def test_rows_may_change_between_steps_and_greedy_needs_no_chance(prior):
    controller = PriorController(prior, greedy=True)
    state = torch.randn(4, prior.gpt.config.state_dim)
    _, many = controller.act(state)
    _, few = controller.act(state[:2])
    assert torch.equal(many[:2], few)
    with pytest.raises(ValueError, match="generator"):
        PriorController(prior).act(state)


def test_a_roll_is_the_same_at_any_thread_count(prior):
    one, two = (roll(prior, rows=6, seconds=1.0, seed=5, threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.tokens, two.tokens)
    np.testing.assert_array_equal(one.qpos, two.qpos)
    other = roll(prior, rows=6, seconds=1.0, seed=6, threads=1)
    assert not np.array_equal(one.tokens, other.tokens)


def test_a_recording_pairs_each_state_with_its_tokens(prior):
    starts = np.array([3, 3, 1])
    made = roll(prior, rows=3, seconds=0.5, starts=starts, seed=0, threads=1)
    assert made.qpos.shape == (15, 3, prior.character.nq) and made.tokens.shape == (15, 3, 2)
    assert made.pos.shape == (15, 3, 15, 3) and made.fps == 30 and made.vocabulary == 125
    np.testing.assert_array_equal(made.start, starts)
    np.testing.assert_allclose(made.qpos[0], prior.starts.qpos[starts])
    np.testing.assert_allclose(made.pos[:, :, 0], made.qpos[..., :3], atol=1e-5)
    assert not made.blown_up.any()


def test_a_push_changes_nothing_before_its_step_and_its_direction_comes_from_the_seed(prior):
    calm = roll(prior, rows=4, seconds=0.5, seed=1, threads=1)
    pushed = roll(prior, rows=4, seconds=0.5, seed=1, push=2.4, push_at=10, threads=1)
    np.testing.assert_array_equal(calm.qpos[:11], pushed.qpos[:11])
    moved = (pushed.qpos - calm.qpos)[11, :, :2]
    # 2.4 m/s for one control step of 1/30 s, but for the ground's resistance
    assert (np.linalg.norm(moved, axis=1) > 0.04).all() and (np.linalg.norm(moved, axis=1) < 0.1).all()
    angle = np.arctan2(moved[:, 1], moved[:, 0])
    expected = np.random.default_rng([1, 1]).uniform(0, 2 * np.pi, 4)
    assert np.cos(angle - expected).min() > 0.9
    with pytest.raises(ValueError, match=r"the push comes at step 200 of 15; roll longer than 6\.7 s"):
        roll(prior, rows=1, seconds=0.5, push=1.0)
