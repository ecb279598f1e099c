"""hindsight.py: what a path came to is what was asked for, from clips and from the policy's own play."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from kinetok.adapters import finetune as room
from kinetok.adapters.finetune import FinetuneConfig, finetune, reshaped
from kinetok.adapters.hindsight import HindsightConfig, balance, relabel
from kinetok.adapters.lora import LoRAConfig
from kinetok.checkpoint import load_state
from kinetok.gpt.controller import Prior
from kinetok.gpt.data import Rollout
from kinetok.logger import read_metrics
from kinetok.presets import FINETUNE
from kinetok.rotation import about_z
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.target import Target, TargetConfig

SMALL = HindsightConfig(
    rounds=2, rows=8, seconds=1.5, iterations=3, batch=16, memory=1, samples=480, doomed=0.1, env=EnvConfig(push=0.1)
)


def config(**changes) -> FinetuneConfig:
    tiny = replace(FINETUNE["tiny"](), adapter=LoRAConfig(rank=2, alpha=4.0, hidden=8), methods=("hindsight",))
    tiny = replace(tiny, env=EnvConfig(episode_seconds=2.0), eval_episodes=2, eval_seconds=0.2, hindsight=SMALL)
    return replace(tiny, **changes)


def run(models, out, settings, **options):
    prior = Prior.from_pretrained(models / "prior")
    return finetune(prior, settings, out, base=models / "prior", threads=1, quiet=True, **options)


@pytest.mark.parametrize("task", ["target", "steering"])
def test_a_task_learns_from_its_own_play(models, tmp_path, task):
    settings = config(hindsight=replace(SMALL, rounds=1))
    run(models, tmp_path, reshaped(settings, task=task, adapter="lora"))
    assert "hindsight, 1 rounds" in (tmp_path / "README.md").read_text()


def test_clips_are_kept_and_the_first_round_is_theirs_alone(models, clips, tmp_path):
    run(models, tmp_path, config(), clips=clips)
    sizes = [row["samples"] for row in read_metrics(tmp_path / "metrics.jsonl") if "samples" in row]
    assert len(sizes) == 2 and 0 < sizes[0] < 480 and sizes[1] > sizes[0]
    assert "what the tokenizer does of the clips cycle, once" in (tmp_path / "README.md").read_text()


def test_a_resumed_run_is_the_unbroken_one(models, clips, tmp_path, monkeypatch):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    run(models, whole, config(), clips=clips)
    real, calls = room.play, []

    def stop(*args, **options):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args, **options)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(room, "play", stop)
        run(models, cut, config(), clips=clips)
    torch.manual_seed(5)
    run(models, cut, config(), clips=clips)
    (found, meta), (expected, whole_meta) = (load_state(out / "state.safetensors") for out in (cut, whole))
    assert meta == whole_meta and all(torch.equal(found[name], expected[name]) for name in expected)


def straight(prior: Prior, steps: int) -> tuple[Rollout, Env]:
    """Two rows that go ahead at 1.2 m/s, headed along y; the second falls at step 50 and a new path begins."""
    rolled = Rollout.empty(steps, 2, 3, 2)
    rolled.states[:], rolled.tokens[:] = torch.arange(steps)[:, None, None], 0
    rolled.root[:] = 0
    rolled.root[..., 1] = np.arange(steps)[:, None] * 0.04
    rolled.root[..., 3:] = about_z(np.full((steps, 2), np.pi / 2))
    rolled.terminated[50, 1] = rolled.cut[50, 1] = True
    starts = prior.starts
    task = Target(TargetConfig(fall_height=0.1), prior.character, starts.qpos, starts.qvel, rows=2)
    return rolled, Env(EnvConfig(), task, rows=2, threads=1)


def test_the_target_of_a_straight_path_lies_straight_ahead(prior):
    rolled, env = straight(prior, 200)
    state, c, tokens, weight = relabel(rolled, env, replace(SMALL, doomed=1.0), seed=0)
    assert len(state) == len(c) == len(tokens) == len(weight) > 100
    np.testing.assert_allclose(c[:, 1], 0, atol=1e-4)
    assert c[:, 0].min() >= 0.04 * 15 - 1e-4 and 3 < c[:, 0].max() < 0.04 * 60 + 5  # two seconds ahead, then 5 m on
    # No step looks past the end of its path, and none of the last second before the fall is learned.
    at = state[:, 0]
    assert at.max() == 199 - 15
    fallen = np.bincount(at.long().numpy(), minlength=200)
    assert fallen[21:51].max() == 1 and fallen[51:].max() == 2


def test_rare_directions_are_drawn_as_often_as_they_are_asked_for():
    ahead, left = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 1.0]])
    fulfilled = torch.cat([ahead.repeat(90, 1), left.repeat(10, 1)])
    asked = torch.cat([ahead.repeat(50, 1), left.repeat(50, 1)])
    weight = balance(fulfilled, asked, HindsightConfig())
    assert float(weight[:90].sum()) == pytest.approx(float(weight[90:].sum()))
    assert float(balance(fulfilled, left, HindsightConfig())[95]) == 10.0  # the boost, at most
