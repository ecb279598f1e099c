"""training.py: the best is kept, a resumed run is the unbroken one, and what is not finite stops it."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from toy import Aim, Line

from kinetok.checkpoint import CheckpointError, load_state, save_state
from kinetok.config import to_dict
from kinetok.logger import read_metrics
from kinetok.resume import refuse_changed
from kinetok.rl.average import Average
from kinetok.rl.nets import Critic
from kinetok.rl.policy import Gaussian
from kinetok.rl.ppo import PPOConfig
from kinetok.rl.training import Training

ROWS, HORIZON = 16, 4  # 64 samples an iteration


@dataclass(frozen=True, kw_only=True)
class Stage:
    samples: int = 512
    lr: float = 1e-3
    rows: int = ROWS


class Room(Aim):
    """Aim with what a training asks of a world besides; `spoil` is a function of the rewards of a step."""

    failed_simulations = 0

    def __init__(self, spoil=lambda reward: reward, **settings):
        super().__init__(ROWS, **settings)
        self.spoil = spoil

    def reset(self, *, spread=False):
        self.obs = self.fresh(np.arange(self.rows))
        if spread:
            self.age[:] = self.rng.integers(0, self.length, self.rows)
        return self.obs.copy()

    def step(self, action):
        step = super().step(action)
        step.reward = self.spoil(step.reward)
        return step

    def episode_metrics(self):
        return {}

    def state_dict(self):
        return {"rng": self.rng.bit_generator.state}

    def load_state_dict(self, state):
        self.rng.bit_generator.state = state["rng"]


@dataclass(frozen=True)
class Found:
    merit: float

    def summary(self):
        return {"merit": self.merit}

    def to_json(self):
        return {"merit": self.merit}


class Run:
    """A training of Line in Room; `kept` are the weights that were kept, by merit."""

    def __init__(self, out, *, seed=0, stage=None, ema=0.0, **settings):
        torch.manual_seed(seed)
        self.actor, self.kept, self.stage = Line(), [], stage or Stage()
        self.training = Training(
            out=out,
            world=Room(seed=seed, **settings),
            policy=Gaussian(self.actor, -1.5),
            critic=Critic(2, [8]),
            config=PPOConfig(horizon=HORIZON, minibatch=32, lr=self.stage.lr, gamma=0.5),
            modules={"actor": self.actor},
            identity={"stage": to_dict(self.stage), "seed": seed},
            kinds={"stage": Stage},
            seed=seed,
            average=Average(self.actor.parameters(), ema) if ema else None,
        )

    def train(self, merits=None, **options):
        given = iter(merits or range(100))
        return self.training.train(
            samples=self.stage.samples,
            eval_every=128,
            evaluate=lambda: Found(float(next(given))),
            keep=lambda score: self.kept.append((score.merit, self.actor.line.weight.detach().clone())),
            quiet=True,
            **options,
        )


def untimed(out):
    return [{k: v for k, v in line.items() if k != "time"} for line in read_metrics(out / "metrics.jsonl")]


def state(out):
    return load_state(out / "state.safetensors")


def test_only_a_better_score_is_kept(tmp_path):
    run = Run(tmp_path)
    progress = run.train(merits=[3.0, 1.0, 3.0, 4.0])
    assert [merit for merit, _ in run.kept] == [3.0, 4.0]
    assert progress.best == 4.0 and progress.stale == 0 and progress.score == {"merit": 4.0}
    assert [line["step"] for line in untimed(tmp_path) if "eval/merit" in line] == [128, 256, 384, 512]
    assert state(tmp_path)[1]["progress"] == vars(progress)


def test_or_every_one_and_the_last_stays(tmp_path):
    run = Run(tmp_path)
    progress = run.train(merits=[3.0, 4.0, 1.0, 2.0], latest=True)
    assert [merit for merit, _ in run.kept] == [3.0, 4.0, 1.0, 2.0]
    assert progress.best == 4.0 and progress.stale == 2 and progress.score == {"merit": 2.0}


@pytest.mark.parametrize("stop_at", [256, 384])
def test_a_resumed_run_is_the_unbroken_one(tmp_path, stop_at):
    Run(tmp_path / "whole").train(merits=[1.0, 2.0, 3.0, 0.0])
    cut = Run(tmp_path / "cut", stage=Stage(samples=stop_at))
    cut.train(merits=[1.0, 2.0, 3.0][: stop_at // 128])
    resumed = Run(tmp_path / "cut")
    resumed.actor.line.weight.data.fill_(7.0)  # the weights come from the state
    progress = resumed.train(merits=[1.0, 2.0, 3.0, 0.0][stop_at // 128 :])
    (tensors, meta), (expected, expected_meta) = state(tmp_path / "cut"), state(tmp_path / "whole")
    assert tensors.keys() == expected.keys() and all(torch.equal(tensors[k], expected[k]) for k in tensors)
    assert meta == expected_meta and progress.best == 3.0
    assert untimed(tmp_path / "cut") == untimed(tmp_path / "whole")


def test_with_an_average_it_is_judged_and_kept_and_resumed(tmp_path):
    whole = Run(tmp_path / "whole", ema=0.5)
    whole.train()
    plain = Run(tmp_path / "plain")
    plain.train()
    assert torch.equal(whole.actor.line.weight, plain.actor.line.weight)  # what is learned from is not the average
    assert not torch.equal(whole.kept[-1][1], plain.kept[-1][1])
    Run(tmp_path / "cut", stage=Stage(samples=256), ema=0.5).train()
    cut = Run(tmp_path / "cut", ema=0.5)
    cut.train(merits=[2.0, 3.0])
    tensors, expected = (state(tmp_path / name)[0] for name in ("cut", "whole"))
    assert tensors.keys() == expected.keys() and all(torch.equal(tensors[k], expected[k]) for k in tensors)
    assert torch.equal(cut.kept[-1][1], whole.kept[-1][1])


def test_saved_at_some_evaluations_alone_a_resumed_run_is_the_unbroken_one(tmp_path):
    Run(tmp_path / "whole").train(save_every=256)

    def stop(reward):
        steps.append(1)
        if len(steps) == 28:  # after the third evaluation, which no save followed
            raise KeyboardInterrupt
        return reward

    steps = []
    with pytest.raises(KeyboardInterrupt):
        Run(tmp_path / "cut", spoil=stop).train(save_every=256)
    assert state(tmp_path / "cut")[1]["progress"]["samples"] == 256
    Run(tmp_path / "cut").train(merits=[2.0, 3.0], save_every=256)
    (tensors, meta), (expected, expected_meta) = state(tmp_path / "cut"), state(tmp_path / "whole")
    assert all(torch.equal(tensors[k], expected[k]) for k in expected) and meta == expected_meta
    assert untimed(tmp_path / "cut") == untimed(tmp_path / "whole")


def test_a_finished_run_does_nothing(tmp_path):
    Run(tmp_path).train()
    before = state(tmp_path)[1]
    again = Run(tmp_path)
    progress = again.train(merits=[9e9])
    assert not again.kept and vars(progress) == before["progress"]


def test_rollouts_move_the_normalisers_of_a_fresh_policy_only(tmp_path):
    fresh, warm = Run(tmp_path / "a", stage=Stage(samples=192)), Run(tmp_path / "b", stage=Stage(samples=192))
    fresh.train()
    warm.train(warm=True)
    assert float(fresh.actor.norm.count) == 192 and float(warm.actor.norm.count) == 0
    assert float(warm.training.critic.norm.count) == 192


@pytest.mark.parametrize(("bad", "message"), [(np.nan, "2 of 64 rewards are not finite"), (np.inf, "2 of 64 rewards")])
def test_a_reward_that_is_not_finite_stops_the_run(tmp_path, bad, message):
    def spoil(reward):
        steps.append(1)
        return np.where(np.arange(ROWS) < 2 * (len(steps) == 22), np.float32(bad), reward)  # in the sixth rollout

    steps = []
    run = Run(tmp_path, spoil=spoil)
    with pytest.raises(FloatingPointError, match=message) as error:
        run.train()
    assert f"the last good state in {tmp_path / 'state.safetensors'} is untouched" in str(error.value)
    assert state(tmp_path)[1]["progress"]["samples"] == 256 and [merit for merit, _ in run.kept] == [0.0, 1.0]
    dumped, _ = load_state(tmp_path / "bad_rollout.safetensors")
    assert (~torch.isfinite(dumped["rewards"])).sum() == 2 and {"obs", "action", "log_prob"} <= dumped.keys()
    good = Run(tmp_path)  # and a run goes on from there
    assert good.train().samples == 512


def test_before_the_first_evaluation_nothing_was_saved(tmp_path):
    with pytest.raises(FloatingPointError, match="nothing was saved yet"):
        Run(tmp_path, spoil=lambda reward: reward * np.nan).train()
    assert not (tmp_path / "state.safetensors").exists()


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path):
    run = Run(tmp_path)
    run.actor.weight = float("inf")
    with pytest.raises(FloatingPointError, match=r"loss is (inf|nan); training stopped.*--set ppo\.lr"):
        run.train()
    assert torch.isfinite(run.actor.line.weight).all()


def test_an_observation_that_is_not_finite_stops_the_run(tmp_path):
    run = Run(tmp_path, spoil=np.nan_to_num)
    fresh = run.training.world.fresh
    run.training.world.fresh = lambda ids: fresh(ids) * np.float32("nan")
    with pytest.raises(FloatingPointError, match="observations hold a value that is not finite; training stopped"):
        run.train()


def test_another_run_is_refused_saying_what_changed(tmp_path):
    Run(tmp_path).train()
    with pytest.raises(
        CheckpointError, match=r"state\.safetensors: .*stage\.lr: 0\.001 -> 0\.0005; seed: 0 -> 3.*--out"
    ):
        Run(tmp_path, stage=Stage(lr=5e-4), seed=3).train()
    with pytest.raises(CheckpointError, match=r"stage\.samples: 512 -> 256"):
        Run(tmp_path, stage=Stage(samples=256)).train()
    assert Run(tmp_path, stage=Stage(samples=576)).train().samples == 576  # a longer run is the same run


@pytest.mark.parametrize(
    ("identity", "message"),
    [
        ({"config": {}}, "of another kind of run: it has no stage"),
        ({"stage": {"samples": 1, "batch": 2}}, "of another kind of run, or of another version .*unknown key 'batch'"),
        ({"stage": {"samples": 512}, "seed": 0}, None),  # settings it did not know had their defaults
    ],
)
def test_a_foreign_or_older_state(tmp_path, identity, message):
    path, new = tmp_path / "state.safetensors", {"stage": to_dict(Stage()), "seed": 0}
    if message is None:
        refuse_changed(path, identity, new, {"stage": Stage})
        return
    with pytest.raises(CheckpointError, match=message):
        refuse_changed(path, identity, new, {"stage": Stage})


def test_the_state_is_plain_and_only_ours_is_read(tmp_path):
    Run(tmp_path).train()
    json.dumps(state(tmp_path)[1])
    save_state(tmp_path / "state.safetensors", {}, {"identity": {"stage": {}}})
    with pytest.raises(CheckpointError, match=r"seed: \(absent\) -> 0"):
        Run(tmp_path).train()
