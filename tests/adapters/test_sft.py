"""sft.py: it learns the clips whatever the task says, keeps the best, goes on bit for bit, refuses other settings."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from kinetok.adapters import CoLAConfig, FullConfig, LoRAConfig
from kinetok.adapters.adapted import Adapted
from kinetok.adapters.sft import SFTConfig, supervise
from kinetok.checkpoint import CheckpointError, load_state
from kinetok.config import ConfigError
from kinetok.gpt.controller import Prior
from kinetok.logger import read_metrics
from kinetok.sim.env import EnvConfig

SMALL = SFTConfig(
    samples=160, rows=8, iterations=4, batch=16, lr=1e-2, eval_every=2, held_out=0.25, env=EnvConfig(reset_noise=0.02)
)
DROPPING = LoRAConfig(rank=2, alpha=4.0, hidden=8, dropout=0.3)


class Run:
    """One call of `supervise` on a fresh adapter; `kept` are the metrics and adapters that were saved."""

    def __init__(self, prior, clips, out, adapter=DROPPING, stop_at=None):
        torch.manual_seed(0)
        self.adapted, self.prior, self.clips, self.out = Adapted(prior.gpt, adapter, 2), prior, clips, out
        self.kept, self.stop_at = [], stop_at

    def __call__(self, config=SMALL, **options):
        options = {"identity": {"task": "none"}, "threads": 1, "quiet": True} | options
        return supervise(
            self.adapted, self.prior.tokenizer, self.clips, config, self.out, save=self.save, **options
        )  # fmt: skip

    def save(self, metrics):
        if len(self.kept) + 1 == self.stop_at:
            raise KeyboardInterrupt
        self.kept.append((metrics, {name: tensor.clone() for name, tensor in self.adapted.adapter_state().items()}))


@pytest.fixture(scope="module")
def whole(models, clips, tmp_path_factory):
    """A run that was never interrupted."""
    run = Run(Prior.from_pretrained(models / "prior"), clips, tmp_path_factory.mktemp("sft"))
    run.found = run()
    return run


def untimed(out):
    return [{k: v for k, v in line.items() if k != "time"} for line in read_metrics(out / "metrics.jsonl")]


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_a_run_leaves_metrics_and_a_state(whole):
    lines = untimed(whole.out)
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    assert [("held_out/cross_entropy" in line) for line in lines] == [False, True, False, True]
    assert whole.found == whole.kept[-1][0] and len(whole.kept) == 2
    assert whole.kept[1][0]["held_out/cross_entropy"] < whole.kept[0][0]["held_out/cross_entropy"]
    json.dumps(load_state(whole.out / "state.safetensors")[1])


@pytest.mark.parametrize("adapter", [CoLAConfig(rank=4, alpha=8.0, hidden=8), FullConfig(hidden=8)], ids=type)
def test_it_learns_the_clips_whatever_the_task_says(prior, clips, tmp_path, adapter):
    run = Run(prior, clips, tmp_path, adapter)
    conditioner = {name: value.clone() for name, value in run.adapted.conditioner.state_dict().items()}
    found = run(replace(SMALL, iterations=40, eval_every=10))
    first = untimed(tmp_path)[0]["sft/cross_entropy"]
    assert first > np.log(125) - 0.5 and found["held_out/cross_entropy"] < first - 1.0
    assert same(run.adapted.conditioner.state_dict(), conditioner)
    state, tokens = torch.randn(6, prior.gpt.config.state_dim), torch.randint(125, (6, 2))
    logits = run.adapted(state, torch.zeros(6, 2), tokens)
    run.adapted.observe(5.0 + 3.0 * torch.randn(100, 2))  # reinforcement learning sets the statistics of c
    assert torch.equal(run.adapted(state, 100.0 * torch.randn(6, 2), tokens), logits)


def test_dropout_acts_while_it_learns_and_nowhere_else(prior, clips, whole, tmp_path):
    run = Run(prior, clips, tmp_path, replace(DROPPING, dropout=0.0))
    run()
    assert not same(run.adapted.adapter_state(), whole.adapted.adapter_state())
    assert not run.adapted.training and not run.adapted.gpt.training


def test_a_resumed_run_is_the_unbroken_one(prior, clips, whole, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        Run(prior, clips, tmp_path, stop_at=2)()
    assert load_state(tmp_path / "state.safetensors")[1]["step"] == 2
    resumed = Run(prior, clips, tmp_path)
    torch.manual_seed(99)  # what is drawn comes from the state
    assert resumed() == whole.found
    (tensors, meta), (expected, expected_meta) = (
        load_state(out / "state.safetensors") for out in (tmp_path, whole.out)
    )
    assert same(tensors, expected) and meta == expected_meta and untimed(tmp_path) == untimed(whole.out)
    assert same(resumed.kept[-1][1], whole.kept[-1][1])


def test_how_often_it_is_evaluated_changes_nothing(prior, clips, whole, tmp_path):
    run = Run(prior, clips, tmp_path)
    run(replace(SMALL, eval_every=1))
    assert same(run.adapted.adapter_state(), whole.adapted.adapter_state())


def test_a_finished_run_records_nothing(prior, whole, monkeypatch):
    monkeypatch.setattr("kinetok.adapters.sft.record", None)
    again = Run(prior, whole.clips, whole.out)
    assert again() == whole.found and not again.kept
    assert same(again.adapted.adapter_state(), whole.adapted.adapter_state())


def test_only_a_better_evaluation_is_kept(prior, clips, tmp_path, monkeypatch):
    given = iter([3.0, 2.0, 2.0, 4.0])
    monkeypatch.setattr("kinetok.adapters.sft.evaluate", lambda *_: {"held_out/cross_entropy": next(given)})
    run = Run(prior, clips, tmp_path)
    assert run(replace(SMALL, eval_every=1)) == {"held_out/cross_entropy": 2.0, "iteration": 2.0}
    assert [metrics["iteration"] for metrics, _ in run.kept] == [1.0, 2.0]


def test_with_nothing_held_out_the_last_is_kept(prior, clips, tmp_path):
    run = Run(prior, clips, tmp_path)
    assert run(replace(SMALL, held_out=0.0)) == {"iteration": 4.0} and len(run.kept) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"config": replace(SMALL, lr=0.5)}, "sft.lr: 0.01 -> 0.5"),
        ({"config": replace(SMALL, samples=999)}, "sft.samples: 160 -> 999"),  # other data, though more of it
        ({"identity": {"task": "other"}}, "task: none -> other"),
        ({"clips": 1}, "frames: "),
    ],
)
def test_a_changed_run_is_refused(prior, whole, change, message):
    run = Run(prior, whole.clips[: change.pop("clips", 2)], whole.out)
    with pytest.raises(CheckpointError, match=re.escape(message)) as error:
        run(**change)
    assert str(whole.out / "state.safetensors") in str(error.value)


def test_a_loss_that_is_not_finite_stops_the_run(prior, clips, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        Run(prior, clips, tmp_path, stop_at=2)()
    before = (tmp_path / "state.safetensors").read_bytes()
    run = Run(prior, clips, tmp_path)
    prior.gpt.state_mean.fill_(torch.nan)
    with pytest.raises(
        FloatingPointError, match=r"the loss is nan at iteration 2; .*state\.safetensors; try a smaller"
    ):
        run()
    assert (tmp_path / "state.safetensors").read_bytes() == before and not run.kept


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"iterations": 0}, "iterations must be at least 1, not 0"),
        ({"held_out": 1.0}, "held_out is a share of the 64 rows that leaves some, not 1.0"),
        ({"rows": 1}, "held_out is a share of the 1 rows"),
    ],
)
def test_settings_that_cannot_be(settings, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        SFTConfig(**settings)
