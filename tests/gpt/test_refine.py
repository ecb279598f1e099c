"""refine.py: what is learned from, that it goes on where it was, and that the prior as it came is never lost."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made import make_clips, make_tokenizer

from kinetok import resume
from kinetok.checkpoint import CheckpointError, load_artifact, load_state
from kinetok.gpt.controller import Prior
from kinetok.gpt.pretrain import pretrain
from kinetok.gpt.refine import stayed_up
from kinetok.presets import tiny_prior
from kinetok.tokenizers.tokenizer import MotionTokenizer


def test_stayed_up_by_hand():
    # Columns: never falls; falls at step 4, the 2 steps before are doomed; begins on the floor and rises at step 3;
    # stays on the floor, for which 2 steps are granted; has stood, falls at step 2 and gets up again.
    height = np.array(
        [
            [0.9, 0.9, 0.2, 0.2, 0.9],
            [0.9, 0.9, 0.3, 0.2, 0.9],
            [0.9, 0.8, 0.5, 0.2, 0.3],
            [0.9, 0.6, 0.7, 0.2, 0.3],
            [0.9, 0.4, 0.8, 0.2, 0.9],
            [0.9, 0.3, 0.9, 0.2, 0.9],
        ]
    )
    kept = stayed_up(height, doomed=2, patience=2).astype(int).T.tolist()
    assert kept == [[1, 1, 1, 1, 1, 1], [1, 1, 0, 0, 0, 0], [1, 1, 0, 1, 1, 1], [1, 1, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0]]


@pytest.fixture(scope="module")
def made(table, tmp_path_factory):
    """A tokenizer and clips to refine with."""
    path = tmp_path_factory.mktemp("models") / "tokenizer"
    make_tokenizer(path, table)
    return MotionTokenizer.from_pretrained(path), make_clips(table)


def fit(made, out, config=None):
    return pretrain(*made, config or tiny_prior(), out, seed=0, threads=1, quiet=True)


@pytest.fixture(scope="module")
def whole(made, tmp_path_factory):
    out = tmp_path_factory.mktemp("refined")
    return out, fit(made, out)


def test_the_prior_as_it_came_is_kept_beside_the_best(whole):
    out, prior = whole
    plain, best = load_artifact(out / "plain"), load_artifact(out)
    assert plain.kind == best.kind == "prior" and plain.parents == best.parents
    assert isinstance(prior, Prior) and not prior.gpt.training
    assert load_state(out / "refine" / "state.safetensors")[1]["round"] == 1


def test_a_finished_run_returns_at_once_and_the_same(whole, made):
    out, prior = whole
    before = (out / "model.safetensors").read_bytes()
    again = fit(made, out)
    assert (out / "model.safetensors").read_bytes() == before
    assert all(torch.equal(a, b) for a, b in zip(prior.gpt.parameters(), again.gpt.parameters(), strict=True))


def test_a_run_cut_after_a_round_is_the_unbroken_one(made, tmp_path):
    two = replace(tiny_prior(), refine=replace(tiny_prior().refine, rounds=2))
    fit(made, tmp_path / "whole", two)
    with pytest.MonkeyPatch.context() as patch:
        saves, real = [], resume.save_state

        def cut(path, *args):
            real(path, *args)
            saves.append(path)
            raise KeyboardInterrupt

        patch.setattr(resume, "save_state", cut)
        with pytest.raises(KeyboardInterrupt):
            fit(made, tmp_path / "broken", two)
    fit(made, tmp_path / "broken", two)
    states = [load_state(tmp_path / name / "refine" / "state.safetensors") for name in ("whole", "broken")]
    assert all(torch.equal(a, b) for a, b in zip(states[0][0].values(), states[1][0].values(), strict=True))
    assert states[0][1] == states[1][1] and len(saves) == 1


def test_another_refinement_is_refused(whole, made):
    out, _ = whole
    changed = replace(tiny_prior(), refine=replace(tiny_prior().refine, batch=8))
    with pytest.raises(CheckpointError, match=r"stage\.batch: 16 -> 8"):
        fit(made, out, changed)
