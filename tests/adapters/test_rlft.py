"""rlft.py: what PPO is told of a step of tokens, by hand; learning within the nucleus; playing a task."""

import copy
import json
from math import log
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from kinetok.adapters import FullConfig, LoRAConfig
from kinetok.adapters.adapted import Adapted, AdapterPart, fingerprint
from kinetok.adapters.rlft import TaskScore, TokenPolicy, TokenPolicyConfig, play, standing
from kinetok.config import ConfigError
from kinetok.gpt import GPT, GPTConfig
from kinetok.gpt.data import Starts
from kinetok.rl.nets import Critic
from kinetok.rl.ppo import PPOConfig, surrogate
from kinetok.rl.training import Training
from kinetok.sim.tasks import PathConfig, SteeringConfig, TargetConfig
from kinetok.tokenizers.layout import TokenLayout

BASE, BENT, NOW = (0.5, 0.3, 0.15, 0.05), (0.2, 0.3, 0.1, 0.4), (0.6, 0.2, 0.1, 0.1)


class Decoder:
    """Stands where a tokenizer does: the codes themselves are the action."""

    def __init__(self, layout: TokenLayout):
        self.layout = layout

    def decode(self, codes, state):
        return codes.float()


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def weigh(model: GPT, p) -> None:
    """Let every choice of `model` be drawn with the probabilities p, whatever it reads."""
    with torch.no_grad():
        model.head.out.weight.zero_()
        model.head.out.bias.copy_(torch.tensor(p).log())


@pytest.fixture
def policy() -> TokenPolicy:
    """Two tokens a step, each one of four; top_p .7 keeps the base's first two."""
    gpt = GPT(GPTConfig(state_dim=1, tokens_per_step=2, scalars=1, levels=4, width=4, layers=1, heads=1))
    adapted = Adapted(gpt, FullConfig())
    weigh(adapted.base, BASE)
    weigh(adapted.gpt, BENT)
    decoder = Decoder(TokenLayout.grouped(2, 4, 1))
    return TokenPolicy(adapted, decoder, TokenPolicyConfig(top_p=0.7, kl=0.05, entropy=0.01))


def test_a_step_by_hand(policy):
    # Adapted (.2, .3) of the two that are left, renormalised: (.4, .6). After an update (.6, .2) -> (.75, .25).
    # Base (.5, .3) -> (.625, .375). A step is two such choices: log-probability, entropy and KL are sums of two.
    obs = torch.zeros(4000, 3)  # the state, and two columns of a task that this adapter does not read
    action, taken = policy.draw(obs, seeded())
    tokens = taken["tokens"]
    assert torch.equal(action, tokens.float()) and tokens.max() == 1
    assert abs(tokens.float().mean() - 0.6) < 0.03
    then = torch.where(tokens == 1, log(0.6), log(0.4)).sum(-1)
    torch.testing.assert_close(taken["log_prob"], then)
    same = policy.assess(obs, taken)
    torch.testing.assert_close(same.log_prob, then)
    assert abs(float(same.kl)) < 1e-6

    weigh(policy.adapted.gpt, NOW)
    judged = policy.assess(obs, taken)
    now = torch.where(tokens == 1, log(0.25), log(0.75)).sum(-1)
    torch.testing.assert_close(judged.log_prob, now)
    entropy = -2 * (0.75 * log(0.75) + 0.25 * log(0.25))  # 1.1247
    divergence = 2 * (0.75 * log(0.75 / 0.625) + 0.25 * log(0.25 / 0.375))  # 0.0707
    assert judged.metrics["entropy"] == pytest.approx(entropy)
    assert judged.metrics["kl_prior"] == pytest.approx(divergence, rel=1e-4)
    assert judged.loss.item() == pytest.approx(0.05 * divergence - 0.01 * entropy, rel=1e-4)
    # KL(then || now) = 2 (.4 log(.4 / .75) + .6 log(.6 / .25)) = 0.5477, estimated from 4000 draws.
    assert judged.kl == pytest.approx(2 * (0.4 * log(0.4 / 0.75) + 0.6 * log(0.6 / 0.25)), rel=0.05)
    # PPO's ratio of the step is the product over its tokens, .75/.4 for the first option, .25/.6 for the second.
    ratio = (judged.log_prob - taken["log_prob"]).exp()
    expected = torch.tensor([1.875**2, 1.875 * 0.41667, 0.41667**2])[tokens.sum(-1)]
    torch.testing.assert_close(ratio, expected, rtol=1e-4, atol=1e-5)
    clipped = -torch.min(expected, expected.clamp(0.8, 1.2)).mean()  # all advantages 1
    torch.testing.assert_close(surrogate(ratio.log(), torch.ones(4000), 0.2), clipped, rtol=1e-4, atol=1e-5)


def test_the_anchor_pulls_towards_what_it_was_by_hand(policy):
    obs = torch.zeros(50, 1)
    _, taken = policy.draw(obs, seeded())
    held = TokenPolicy(
        policy.adapted, policy.tokenizer, TokenPolicyConfig(top_p=0.7), copy.deepcopy(policy.adapted), 0.3
    )
    at_rest = held.assess(obs, taken)
    assert abs(at_rest.loss.item()) < 1e-6
    weigh(policy.adapted.gpt, NOW)  # (.75, .25) of the two that are left, from (.4, .6)
    divergence = 2 * (0.75 * log(0.75 / 0.4) + 0.25 * log(0.25 / 0.6))  # 0.5051
    judged = held.assess(obs, taken)
    assert judged.metrics["anchor"] == pytest.approx(divergence, rel=1e-4)
    assert judged.loss.item() == pytest.approx(0.3 * divergence, rel=1e-4)
    for _ in range(300):  # with nothing else to learn it goes back, and the anchor stays where it is
        loss = held.assess(obs, taken).loss
        (gradient,) = torch.autograd.grad(loss, policy.adapted.gpt.head.out.bias)
        with torch.no_grad():
            policy.adapted.gpt.head.out.bias -= 2 * gradient
    found = policy.adapted.gpt.head.out.bias.detach()[:2].softmax(-1)
    torch.testing.assert_close(found, torch.tensor([0.4, 0.6]), rtol=0, atol=0.01)


def test_the_loss_of_a_step_has_the_gradient_of_its_parts(policy):
    obs = torch.zeros(50, 1)
    _, taken = policy.draw(obs, seeded())
    plain = TokenPolicy(policy.adapted, policy.tokenizer, TokenPolicyConfig(top_p=0.7))
    assert plain.assess(obs, taken).loss == 0 and "kl_prior" not in plain.assess(obs, taken).metrics
    bias = policy.adapted.gpt.head.out.bias
    (gradient,) = torch.autograd.grad(policy.assess(obs, taken).loss, bias)
    assert gradient[:2].abs().min() > 0 and gradient[2:].abs().max() == 0  # nothing pulls at what cannot be drawn


def test_without_a_generator_the_most_probable_are_taken_and_rows_may_change(policy):
    for rows in (3, 5, 2):
        action, taken = policy.draw(torch.zeros(rows, 1), None)
        assert torch.equal(action, torch.ones(rows, 2))
        torch.testing.assert_close(taken["log_prob"], torch.full((rows,), 2 * log(0.6)))
    assert torch.equal(policy.controller(None)(torch.zeros(2, 1)), torch.ones(2, 2))


class Guess:
    """Worlds that show a state and a task, 1 or -1, and reward the first of two codes for being `want` where the task
    is 1 and `other` where it is -1. Rows never end."""

    obs_size, action_size, failed_simulations = 2, 2, 0

    def __init__(self, rows, want, other):
        self.rows, self.want, self.other, self.rng, self.seen = rows, want, other, np.random.default_rng(0), []

    def reset(self, *, spread=False):
        task = self.rng.choice([-1.0, 1.0], self.rows)
        self.obs = np.stack([self.rng.normal(size=self.rows), task], axis=1).astype(np.float32)
        return self.obs.copy()

    def step(self, action):
        self.seen.append(action.copy())
        wanted = np.where(self.obs[:, 1] > 0, self.want, self.other)
        reward, none = (action[:, 0] == wanted).astype(np.float32), np.zeros(self.rows, bool)
        return SimpleNamespace(obs=self.reset(), reward=reward, terminated=none, done=np.array([], int), final_obs=None)

    def episode_metrics(self):
        return {}

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def test_reward_moves_the_tokens_within_the_nucleus_and_by_the_task_alone(tmp_path):
    torch.manual_seed(0)
    gpt = GPT(GPTConfig(state_dim=1, tokens_per_step=2, scalars=1, levels=5, width=16, layers=1, heads=2))
    weigh(gpt, (0.4, 0.3, 0.15, 0.1, 0.05))  # top_p .8 keeps 0, 1 and 2
    with torch.no_grad():
        gpt.head.out.weight.normal_(std=0.02)
    adapted = Adapted(gpt.eval(), LoRAConfig(rank=4, alpha=8.0, targets=("blocks", "head")), cond_dim=1)
    policy = TokenPolicy(adapted, Decoder(TokenLayout.grouped(2, 5, 1)), TokenPolicyConfig(top_p=0.8))
    before = fingerprint(gpt)
    world = Guess(128, want=2, other=1)
    run = Training(
        out=tmp_path,
        world=world,
        policy=policy,
        critic=Critic(2, [16]),
        config=PPOConfig(horizon=4, minibatch=256, epochs=2, gamma=0.0, lam=0.0, lr=1e-2, lr_max=3e-2, target_kl=0.05),
        modules={"adapter": AdapterPart(policy.adapted)},
        identity={},
        kinds={},
        seed=0,
    )
    score = TaskScore(measures={"reward": 0.0})
    run.train(samples=25 * 512, eval_every=10**9, evaluate=lambda: score, keep=lambda found: None, quiet=True)
    first = np.concatenate([action[:, 0] for action in world.seen[:4]])
    assert 0.1 < (first == 2).mean() < 0.3  # .15 / .85 at the start
    obs = torch.from_numpy(world.reset())
    action, _ = policy.draw(obs, seeded())
    task = obs[:, 1] > 0
    assert (action[task, 0] == 2).float().mean() > 0.8 and (action[~task, 0] == 1).float().mean() > 0.8
    assert np.concatenate(world.seen).max() == 2  # what lies outside the nucleus was never tried
    assert fingerprint(gpt) == before  # and the prior is what it was


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"top_p": 0.0}, r"top_p must lie in \(0, 1\], not 0\.0"),
        ({"top_p": 1.5}, "not 1.5"),
        ({"temperature": 0.0}, "a temperature is above 0"),
        ({"kl": -1.0}, "kl, entropy and guidance are not below it"),
        ({"entropy": -0.1}, "entropy=-0.1"),
    ],
)
def test_settings_that_cannot_be(settings, message):
    with pytest.raises(ConfigError, match=message):
        TokenPolicyConfig(**settings)


def blind(prior, seed=0):
    """The prior, drawing tokens without an eye to the task."""
    adapted = Adapted(prior.gpt, LoRAConfig(rank=1), cond_dim=0)
    return TokenPolicy(adapted, prior.tokenizer, TokenPolicyConfig()).controller(seeded(seed))


@pytest.mark.parametrize("task", [TargetConfig(), SteeringConfig(), PathConfig()], ids=lambda c: c.kind)
def test_playing_depends_on_the_seed_and_not_on_the_threads(prior, task):
    one, two = (play(blind(prior), task, prior, episodes=3, seconds=0.5, threads=t, seed=1, record=2) for t in (1, 2))
    np.testing.assert_array_equal(one.qpos, two.qpos)
    assert one.score == two.score and one.markers == two.markers
    assert one.qpos.shape == (15, 2, prior.character.nq) and len(one.markers) == 15 and one.fps == 30
    other = play(blind(prior), task, prior, episodes=3, seconds=0.5, threads=1, seed=2, record=2)
    assert not np.array_equal(one.qpos, other.qpos)
    assert one.score.merit == one.score.measures["reward"] and one.score.measures["episodes"] == 3
    assert all(isinstance(value, float) for value in one.score.summary().values())
    json.dumps(one.score.to_json(), allow_nan=False)


def test_a_video_has_the_markers_of_the_character_it_shows(prior):
    one, many = (
        play(blind(prior), TargetConfig(), prior, episodes=n, seconds=0.1, threads=1, record=n) for n in (1, 4)
    )
    assert [len(markers) for markers in many.markers] == [len(markers) for markers in one.markers] == [3] * 3
    root = many.markers[0][2].pos[:2]  # the line begins below the root
    np.testing.assert_allclose(root, many.qpos[0, 0, :2], atol=1e-6)


def test_pushes_come_every_two_seconds(prior):
    calm, pushed = (
        play(blind(prior), TargetConfig(), prior, episodes=2, seconds=2.5, push=push, threads=1, record=2)
        for push in (0.0, 1.0)
    )
    same = [np.array_equal(a, b) for a, b in zip(calm.qpos, pushed.qpos, strict=True)]
    assert same.index(False) in (60, 61) and not any(same[61:])


def test_playing_leaves_the_chance_of_others_alone(prior):
    controller = blind(prior)
    before = torch.get_rng_state(), np.random.get_state()[1].copy()
    play(controller, TargetConfig(), prior, episodes=2, seconds=0.1, threads=1)
    assert torch.equal(torch.get_rng_state(), before[0]) and (np.random.get_state()[1] == before[1]).all()


def test_what_cannot_be_played_is_refused(prior):
    with pytest.raises(ValueError, match=r"2 episodes of 0\.01 s hold no control step of 1/30 s"):
        play(blind(prior), TargetConfig(), prior, episodes=2, seconds=0.01)
    lying = Starts(qpos=np.zeros((3, 43)), qvel=np.zeros((3, 42)), clip=np.zeros(3, int))
    with pytest.raises(ValueError, match=r"none of the prior's 3 start states has its root above fall_height 0\.5 m"):
        standing(lying, 0.5)


def test_a_network_that_knows_no_tokens_plays_too(prior):
    def still(obs):
        return torch.zeros(len(obs), prior.character.nu)

    assert play(still, TargetConfig(), prior, episodes=2, seconds=0.1, threads=1).qpos.shape == (0, 0, 43)
