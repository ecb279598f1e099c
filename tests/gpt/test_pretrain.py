"""pretrain.py: it learns, goes on bit for bit, and refuses other settings and other tokenizers."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from made import make_clips, make_tokenizer

from kinetok import resume
from kinetok.checkpoint import CheckpointError, load_artifact, load_state
from kinetok.config import ConfigError
from kinetok.gpt import pretrain as room
from kinetok.gpt.controller import Prior
from kinetok.gpt.data import Starts, TokenDataset
from kinetok.gpt.model import GPT, GPTConfig
from kinetok.gpt.pretrain import PretrainConfig, learning_rate, pretrain, train
from kinetok.logger import read_metrics

SMALL = PretrainConfig(
    width=16, layers=1, heads=2, samples=800, rows=20, iterations=6, batch=32, warmup=2, eval_every=3, transitions=1.0
)


@pytest.fixture(scope="module")
def clips(table):
    return make_clips(table)


@pytest.fixture(scope="module")
def tokenizer_dir(tmp_path_factory, table):
    path = tmp_path_factory.mktemp("models") / "tokenizer"
    make_tokenizer(path, table)
    return path


@pytest.fixture
def tokenizer(tokenizer_dir):
    return room.MotionTokenizer.from_pretrained(tokenizer_dir)


def toy() -> TokenDataset:
    """Tokens that the signs of the state decide: t0 = [s0 > 0], t1 = 2 t0 + [s1 > 0]."""
    states = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    first = (states[:, 0] > 0).int()
    tokens = torch.stack([first, 2 * first + (states[:, 1] > 0).int()], dim=1)
    starts = Starts(qpos=np.zeros((1, 7)), qvel=np.zeros((1, 6)), clip=np.zeros(1, int))
    world = torch.arange(2000, dtype=torch.int32) % 20
    return TokenDataset(states=states, tokens=tokens, clip=world, world=world, names=("toy",), starts=starts)


@pytest.mark.parametrize("head", ["softmax", "factorised"])
def test_it_learns_what_can_be_learned(tmp_path, head):
    config = replace(SMALL, iterations=150, eval_every=50, batch=128, lr=1e-2, ema=0.9, state_noise=0.0)
    gpt = GPT(GPTConfig(state_dim=3, tokens_per_step=2, scalars=2, levels=2, width=16, layers=1, heads=2, head=head))
    kept = []
    best = train(
        gpt, toy(), config, tmp_path, identity={}, save=lambda _, found: kept.append(found), threads=1, quiet=True
    )
    lines = [line for line in read_metrics(tmp_path / "metrics.jsonl") if "train/cross_entropy" in line]
    assert lines[-1]["train/cross_entropy"] < 0.5 * lines[0]["train/cross_entropy"]
    assert best["held_out/accuracy"] > 0.9 and best["held_out/cross_entropy"] < 0.3  # uniform: log 4 = 1.39
    assert kept[-1] == best


def test_the_learning_rate_warms_up_and_falls_by_a_cosine():
    config = replace(SMALL, iterations=102, warmup=2, lr=1.0, lr_end=0.2)
    # half-way of the cosine: (1 + 0.2) / 2; its end is just after the last iteration
    assert [round(learning_rate(step, config), 6) for step in (0, 1, 2, 52, 102)] == [0.5, 1.0, 1.0, 0.6, 0.2]


def test_pretraining_leaves_an_artifact_that_finds_its_tokenizer(tokenizer, tokenizer_dir, clips, tmp_path):
    out = tmp_path / "prior"
    prior = pretrain(tokenizer, clips, SMALL, out, tokenizer_path=tokenizer_dir, threads=1, quiet=True)
    artifact = load_artifact(out, "prior")
    assert artifact.parents == {"tokenizer": tokenizer.hash} and artifact.config["clips"] == ["cycle", "once"]
    again = Prior.from_pretrained(out)
    assert again.tokenizer.hash == tokenizer.hash and len(again.starts.qpos) == 512
    assert not again.gpt.training and again.fps == 30
    for name, tensor in prior.gpt.state_dict().items():
        assert torch.equal(tensor, again.gpt.state_dict()[name])
    card = (out / "README.md").read_text()
    assert "cross-entropy" in card and "cycle, once" in card and str(tmp_path) not in card
    assert str(tmp_path) not in (out / "config.json").read_text()


def test_it_begins_as_another_prior(tokenizer, clips, tmp_path):
    first = pretrain(tokenizer, clips, SMALL, tmp_path / "first", threads=1, quiet=True)
    still = replace(SMALL, start=str(tmp_path / "first"), lr=0.0, lr_end=0.0, held_out=0.0)
    again = pretrain(tokenizer, clips[:1], still, tmp_path / "again", threads=1, quiet=True)
    assert all(torch.equal(t, again.gpt.state_dict()[name]) for name, t in first.gpt.state_dict().items())
    moved = pretrain(tokenizer, clips[:1], replace(still, lr=1e-3), tmp_path / "moved", threads=1, quiet=True)
    assert not torch.equal(moved.gpt.norm.weight, first.gpt.norm.weight)
    with pytest.raises(ConfigError, match=r"first is a prior of another shape: width: 16 -> 32"):
        pretrain(tokenizer, clips, replace(still, width=32), tmp_path / "wider", threads=1, quiet=True)
    assert not (tmp_path / "wider").exists()


def test_a_resumed_run_equals_an_unbroken_one(tokenizer, clips, tmp_path, monkeypatch):
    pretrain(tokenizer, clips, SMALL, tmp_path / "whole", threads=1, quiet=True)
    saved = resume.save_state

    def save_and_stop(path, *rest):
        saved(path, *rest)
        if path.name == "state.safetensors":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(resume, "save_state", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            pretrain(tokenizer, clips, SMALL, tmp_path / "broken", threads=1, quiet=True)
    recorded = (tmp_path / "broken" / "tokens.safetensors").stat().st_mtime_ns
    pretrain(tokenizer, clips, SMALL, tmp_path / "broken", threads=1, quiet=True)
    assert (tmp_path / "broken" / "tokens.safetensors").stat().st_mtime_ns == recorded
    whole, broken = (load_artifact(tmp_path / name) for name in ("whole", "broken"))
    assert whole.hash == broken.hash
    states = [load_state(tmp_path / name / "state.safetensors")[0] for name in ("whole", "broken")]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    logs = [
        [{k: v for k, v in line.items() if k != "time"} for line in read_metrics(tmp_path / name / "metrics.jsonl")]
        for name in ("whole", "broken")
    ]
    assert logs[0] == logs[1]


def test_other_settings_are_refused_by_name(tokenizer, clips, tmp_path):
    pretrain(tokenizer, clips, SMALL, tmp_path, threads=1, quiet=True)
    with pytest.raises(CheckpointError, match=r"config.lr: 0.001 -> 0.1. .* another --out"):
        pretrain(tokenizer, clips, replace(SMALL, lr=0.1), tmp_path, threads=1, quiet=True)
    with pytest.raises(CheckpointError, match=r"tokens.safetensors: .*config.transitions: 1.0 -> 2.0"):
        pretrain(tokenizer, clips, replace(SMALL, transitions=2.0), tmp_path, threads=1, quiet=True)
    with pytest.raises(CheckpointError, match=r"tokens.safetensors: .*config.reach_at_end: 0.25 -> 0.6"):
        pretrain(tokenizer, clips, replace(SMALL, reach_at_end=0.6), tmp_path, threads=1, quiet=True)
    with pytest.raises(CheckpointError, match=r"clips: \['cycle', 'once'\] -> \['cycle'\]"):
        pretrain(tokenizer, clips[:1], SMALL, tmp_path, threads=1, quiet=True)


def test_another_tokenizer_is_refused_with_both_hashes(tokenizer, tokenizer_dir, clips, table, tmp_path):
    out = tmp_path / "prior"
    pretrain(tokenizer, clips, SMALL, out, tokenizer_path=tokenizer_dir, threads=1, quiet=True)
    other = make_tokenizer(tmp_path / "other", table, seed=1)
    with pytest.raises(CheckpointError, match=f"{tokenizer.hash[:12]}.*other is {other.hash[:12]}"):
        Prior.from_pretrained(out, tmp_path / "other")
    with pytest.raises(CheckpointError, match=f"{tokenizer.hash[:12]}.*{other.hash[:12]}"):
        Prior.from_pretrained(out, other)


def test_a_prior_that_cannot_find_its_tokenizer_says_how_to_give_it(tokenizer, clips, tmp_path):
    pretrain(tokenizer, clips, SMALL, tmp_path, threads=1, quiet=True)
    with pytest.raises(CheckpointError, match=r"does not say where its tokenizer is; .*--tokenizer DIR"):
        Prior.from_pretrained(tmp_path)
    header = json.loads((tmp_path / "config.json").read_text())
    header["config"]["tokenizer"] = "../gone"
    (tmp_path / "config.json").write_text(json.dumps(header))
    with pytest.raises(CheckpointError, match=r"its tokenizer is not at '../gone'; .*--tokenizer DIR"):
        Prior.from_pretrained(tmp_path)
    assert Prior.from_pretrained(tmp_path, tokenizer).clips == ("cycle", "once")


def test_a_tokenizer_that_was_never_saved_is_refused(tokenizer, clips, tmp_path):
    tokenizer.hash = ""
    with pytest.raises(ConfigError, match=r"save it, then load it with MotionTokenizer.from_pretrained"):
        pretrain(tokenizer, clips, SMALL, tmp_path, quiet=True)
