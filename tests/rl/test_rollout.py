"""rollout.py: what is collected is what happened; values beyond an end are zero or bootstrapped, never the reset's."""

import pytest
import torch
from toy import Aim, Line

from kinetok.rl.nets import Critic
from kinetok.rl.policy import Gaussian
from kinetok.rl.rollout import collect, torch_threads

T, N = 6, 3


@pytest.fixture
def critic():
    torch.manual_seed(0)
    return Critic(2, [8])


def roll(critic, world=None, log_std=-1.0, seed=0, actor=None):
    world = world or Aim(N, length=4, mortal=(1,))
    generator = torch.Generator().manual_seed(seed)
    obs = torch.from_numpy(world.obs.copy())
    return world, collect(world, Gaussian(actor or Line(), log_std), critic, obs, horizon=T, generator=generator)


def test_shapes_and_what_the_world_was_given(critic):
    world, rollout = roll(critic)
    assert rollout.obs.shape == (T, N, 2) and rollout.taken["action"].shape == rollout.taken["mean"].shape == (T, N, 1)
    assert [x.shape for x in (rollout.rewards, rollout.values, rollout.next_values, rollout.done)] == [(T, N)] * 4
    torch.testing.assert_close(rollout.taken["action"], torch.tensor([a.tolist() for a in world.taken]))
    reward = -((rollout.taken["action"] - 2 * rollout.obs[..., :1]) ** 2)[..., 0]
    torch.testing.assert_close(rollout.rewards, reward)
    torch.testing.assert_close(rollout.last_obs, torch.from_numpy(world.obs))
    assert not rollout.values.requires_grad


def test_ends(critic):
    _, rollout = roll(critic)
    assert rollout.done.nonzero().tolist() == [[3, 0], [3, 1], [3, 2]]
    torch.testing.assert_close(rollout.values, critic(rollout.obs).detach())
    running = rollout.next_values[[0, 1, 2, 4]]
    torch.testing.assert_close(running, critic(rollout.obs[[1, 2, 3, 5]]).detach())
    torch.testing.assert_close(rollout.next_values[5], critic(rollout.last_obs).detach())
    assert rollout.next_values[3, 1] == 0  # terminated
    final = rollout.obs[3].clone()
    final[:, 1] = 4  # the state before the reset: the same aim, age 4
    torch.testing.assert_close(rollout.next_values[3, [0, 2]], critic(final).detach()[[0, 2]])
    assert rollout.obs[4, :, 1].tolist() == [0, 0, 0]  # and after the reset


def test_noise_has_the_spread_asked_for(critic):
    _, rollout = roll(critic, world=Aim(2000), log_std=-0.7)
    assert (rollout.taken["action"] - rollout.taken["mean"]).std().item() == pytest.approx(0.4966, rel=0.03)  # e^-0.7


def test_one_seed_is_one_rollout(critic):
    first, again, other = (roll(critic, seed=s)[1] for s in (0, 0, 1))
    assert torch.equal(first.taken["action"], again.taken["action"]) and torch.equal(
        first.next_values, again.next_values
    )
    assert not torch.equal(first.taken["action"], other.taken["action"])


def test_threads_are_given_back():
    before = torch.get_num_threads()
    with pytest.raises(RuntimeError, match="inside"), torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
        raise RuntimeError("inside")
    assert torch.get_num_threads() == before
