"""ppo.py: the surrogate by hand, learning on a toy, what stays put, the adaptive rate."""

import copy
from dataclasses import replace

import pytest
import torch
from toy import Aim, Line

from kinetok.config import ConfigError
from kinetok.rl.nets import Critic
from kinetok.rl.policy import Gaussian
from kinetok.rl.ppo import Optimizers, PPOConfig, surrogate, update
from kinetok.rl.returns import gae
from kinetok.rl.rollout import collect

CONFIG = PPOConfig(horizon=8, epochs=3, minibatch=256, lr=2e-2, lr_max=5e-2, critic_lr=1e-2, gamma=0.0, lam=0.0)
LOG_STD = -1.5


def test_surrogate_by_hand():
    # r = 1.5, A = 1: min(1.5, 1.2) = 1.2;  r = 1.5, A = -1: min(-1.5, -1.2) = -1.5
    # r = 0.5, A = 1: min(0.5, 0.8) = 0.5;  r = 0.5, A = -1: min(-0.5, -0.8) = -0.8
    ratio, advantage = torch.tensor([1.5, 1.5, 0.5, 0.5]), torch.tensor([1.0, -1.0, 1.0, -1.0])
    assert surrogate(ratio.log(), advantage, 0.2).item() == pytest.approx(-(1.2 - 1.5 + 0.5 - 0.8) / 4)


class Trial:
    """An actor, its critic and one rollout of the toy world."""

    def __init__(self, config=CONFIG, actor=None, pull=0.0):
        torch.manual_seed(0)
        self.config, self.actor, self.critic = config, actor or Line(), Critic(2, [16])
        anchor = copy.deepcopy(self.actor) if pull else None
        self.policy = Gaussian(self.actor, LOG_STD, anchor, pull)
        self.optimizers = Optimizers(self.policy, self.critic, config)
        self.world, self.generator = Aim(64), torch.Generator().manual_seed(0)
        self.obs = torch.from_numpy(self.world.obs.copy())

    def learn(self, **options):
        rollout = collect(
            self.world, self.policy, self.critic, self.obs, horizon=self.config.horizon, generator=self.generator
        )  # fmt: skip
        self.obs = rollout.last_obs
        done = (rollout.rewards, rollout.values, rollout.next_values, rollout.done)
        advantages, targets = gae(*done, self.config.gamma, self.config.lam)
        arguments = (self.policy, self.critic, self.optimizers, rollout, advantages, targets, self.config)
        metrics = update(*arguments, generator=self.generator, **options)
        return rollout.rewards.mean().item(), metrics


def test_it_learns_the_toy():
    trial = Trial()
    rewards = [trial.learn()[0] for _ in range(30)]
    noise = 0.2231**2  # e^-1.5 squared: the best mean reward is minus the noise's variance
    assert rewards[0] < -1.0 and rewards[-1] > -noise - 0.05, rewards
    weight = trial.actor.line.weight.tolist()[0]
    assert weight == pytest.approx([2.0, 0.0], abs=0.15)


def test_metrics_of_the_first_pass():
    _, metrics = Trial(replace(CONFIG, epochs=1, minibatch=10_000)).learn()
    assert metrics["kl"] == 0.0  # one minibatch, measured before its own step
    assert metrics["policy_loss"] == pytest.approx(0.0, abs=1e-6)  # ratio 1, advantages of mean 0
    assert set(metrics) == {"value_loss", "policy_loss", "kl", "weight", "lr"}


def test_a_frozen_actor_is_bit_identical_while_the_critic_learns():
    trial = Trial()
    before = {k: v.clone() for k, v in trial.actor.state_dict().items()}
    losses = [trial.learn(train_actor=False)[1]["value_loss"] for _ in range(10)]
    assert all(torch.equal(v, before[k]) for k, v in trial.actor.state_dict().items())
    assert losses[-1] < 0.9 * losses[0] and trial.optimizers.lr == CONFIG.lr


def test_an_auxiliary_loss_is_added():
    free, held = Trial(), Trial(actor=Line(weight=10.0))
    for trial in (free, held):
        for _ in range(10):
            trial.learn()
    assert held.actor.line.weight.abs().sum() < 0.3 * free.actor.line.weight.abs().sum()


def test_an_anchor_holds_the_policy():
    free, held = Trial(), Trial(pull=3.0)
    for _ in range(10):
        free.learn()
        _, metrics = held.learn()
    assert metrics["anchor"] > 0
    assert held.actor.line.weight.abs().sum() < 0.5 * free.actor.line.weight.abs().sum()


def test_the_rate_follows_the_kl():
    optimizers = Trial().optimizers
    optimizers.adapt(kl=0.01, target=0.01)
    assert optimizers.lr == pytest.approx(2e-2)
    optimizers.adapt(kl=0.021, target=0.01)
    assert optimizers.lr == pytest.approx(2e-2 / 1.3)
    optimizers.adapt(kl=0.004, target=0.01)
    assert optimizers.lr == pytest.approx(2e-2)
    for _ in range(60):
        optimizers.adapt(kl=0.0, target=0.01)
    assert optimizers.lr == CONFIG.lr_max
    for _ in range(60):
        optimizers.adapt(kl=1.0, target=0.01)
    assert optimizers.lr == 1e-5
    low = Trial(replace(CONFIG, lr=1e-6)).optimizers
    low.adapt(kl=1.0, target=0.01)
    assert low.lr == 1e-6  # what begins lower is not raised
    with pytest.raises(ConfigError, match=r"at most lr_max, 0\.001, not 0\.005; lower it or raise lr_max"):
        PPOConfig(lr=5e-3)


def test_the_divergence_aimed_at_falls_geometrically():
    config = replace(CONFIG, target_kl=0.02, target_kl_end=0.005)
    assert [config.aim(done) for done in (0.0, 0.5, 1.0)] == pytest.approx([0.02, 0.01, 0.005])
    assert replace(CONFIG, target_kl=0.02).aim(1.0) == 0.02
    rates = []
    for done in (0.0, 1.0):
        trial = Trial(replace(CONFIG, target_kl=10.0, target_kl_end=1e-9))
        rates.append(trial.learn(done=done)[1]["lr"])
    assert rates[0] > CONFIG.lr > rates[1]
    with pytest.raises(ConfigError, match=r"not 0.0 and 0.1"):
        PPOConfig(target_kl=0.0, target_kl_end=0.1)


def test_optimizers_resume():
    trial, other = Trial(), Trial()
    for _ in range(2):
        trial.learn()
    other.actor.load_state_dict(trial.actor.state_dict())
    other.critic.load_state_dict(trial.critic.state_dict())
    other.optimizers.load_state_dict(copy.deepcopy(trial.optimizers.state_dict()))
    other.world, other.obs = copy.deepcopy(trial.world), trial.obs.clone()
    other.generator.set_state(trial.generator.get_state())
    trial.learn(), other.learn()
    assert other.optimizers.lr == trial.optimizers.lr
    assert all(torch.equal(a, b) for a, b in zip(trial.actor.parameters(), other.actor.parameters(), strict=True))


def test_a_minibatch_in_chunks_is_the_same_minibatch(monkeypatch):
    whole, chunked = Trial(), Trial()
    told = whole.learn()[1]
    monkeypatch.setattr("kinetok.rl.ppo.CHUNK", 100)  # of 256: unequal chunks
    again = chunked.learn()[1]
    assert again == pytest.approx(told, rel=1e-3)
    for a, b in zip(whole.actor.parameters(), chunked.actor.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_a_loss_that_is_not_finite_stops_before_any_step():
    trial = Trial(actor=Line(weight=float("inf")))
    before = copy.deepcopy(trial.actor.state_dict())
    with pytest.raises(FloatingPointError, match="loss is"):
        trial.learn()
    assert all(torch.equal(v, before[k]) for k, v in trial.actor.state_dict().items())
