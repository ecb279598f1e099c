"""policy.py: a Gaussian's probabilities, divergence and pull by hand. (test_policy.py is the one of adapters.)"""

from math import exp

import pytest
import torch
from toy import Line

from kinetok.rl.policy import Gaussian


@pytest.fixture
def obs():
    return torch.tensor([[1.0, 0.0], [2.0, 0.0], [-1.0, 3.0]])


def seeded():
    return torch.Generator().manual_seed(0)


def test_what_is_drawn_is_the_mean_and_noise_of_the_spread(obs):
    policy = Gaussian(Line(), log_std=-0.5)
    action, taken = policy.draw(obs, seeded())
    noise = exp(-0.5) * torch.randn(3, 1, generator=seeded())
    torch.testing.assert_close(action, noise)  # the mean of a fresh Line is 0
    torch.testing.assert_close(taken["log_prob"], -0.5 * (noise[:, 0] / exp(-0.5)) ** 2)


@torch.no_grad()
def test_assessed_at_once_nothing_has_changed_and_then_by_hand(obs):
    policy = Gaussian(Line(), log_std=0.0)
    action, taken = policy.draw(obs, seeded())
    same = policy.assess(obs, taken)
    assert torch.equal(same.log_prob, taken["log_prob"]) and same.kl == 0 and same.loss == 0
    policy.actor.line.weight.copy_(torch.tensor([[0.5, 0.0]]))  # means .5, 1, -.5 instead of 0
    now = policy.assess(obs, taken)
    torch.testing.assert_close(now.log_prob, -0.5 * (action[:, 0] - torch.tensor([0.5, 1.0, -0.5])) ** 2)
    assert now.kl == pytest.approx(0.5 * (0.25 + 1.0 + 0.25) / 3)  # |difference of means|^2 / 2 std^2


@torch.no_grad()
def test_the_pull_is_the_distance_to_the_anchor_in_units_of_the_noise(obs):
    anchor, actor = Line(), Line(weight=2.0)
    actor.line.weight.copy_(torch.tensor([[1.0, 0.0]]))
    policy = Gaussian(actor, log_std=0.0, anchor=anchor, pull=3.0)
    judged = policy.assess(obs, policy.draw(obs, seeded())[1])
    distance = 0.5 * (1.0 + 4.0 + 1.0) / 3
    assert judged.metrics["anchor"] == pytest.approx(distance)
    assert judged.loss == pytest.approx(2.0 + 3.0 * distance)  # Line's own: 2 |w|^2
    assert list(policy.parameters()) == list(actor.parameters())


def test_observations_reach_the_normaliser(obs):
    actor = Line()
    Gaussian(actor, log_std=0.0).observe(obs)
    assert float(actor.norm.count) == 3
