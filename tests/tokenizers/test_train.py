import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from kinetok.checkpoint import CheckpointError, load_artifact, load_state, save_state
from kinetok.config import ConfigError
from kinetok.logger import read_metrics
from kinetok.motion.library import ClipLibrary
from kinetok.rl import training
from kinetok.rl.training import JUDGE
from kinetok.sim.env import EnvConfig
from kinetok.sim.scene import SceneConfig
from kinetok.sim.tasks.tracking import Failure, ReferenceTable
from kinetok.tokenizers import train
from kinetok.tokenizers.fit import new_tokenizer
from kinetok.tokenizers.tokenizer import MotionTokenizer
from kinetok.tokenizers.track import track
from kinetok.tokenizers.train import PPOStage, in_scene, train_ppo


@pytest.fixture(scope="module")
def config(small) -> PPOStage:
    """Four iterations, the last three of which learn, and evaluations after the second and the fourth; everything
    that draws random numbers is on."""
    env = EnvConfig(reset_noise=0.02, push=0.5, friction=(0.8, 1.2), episode_seconds=0.5)
    return replace(small.ppo, env=env, anchor=0.1, leniency=1.5)


@pytest.fixture(scope="module")
def whole(config, small, standing, tmp_path_factory):
    """One run that was never interrupted: its folder and its score."""
    out = tmp_path_factory.mktemp("whole")
    score = train_ppo(new_tokenizer(small.tokenizer, standing, 0), standing, config, out, quiet=True)
    return out, score


@pytest.fixture
def half(config, student, standing, tmp_path, cut_off):
    """The folder of a run that was cut off at its second evaluation."""
    out = tmp_path / "half"
    cut_off(train, 2, lambda: train_ppo(student, standing, config, out, quiet=True))
    return out


def no_training(monkeypatch):
    def fail(*args, **kwargs):
        raise AssertionError("a finished run trains or evaluates")

    monkeypatch.setattr(training, "collect", fail)
    monkeypatch.setattr(train, "track", fail)


def untimed(out) -> list[dict]:
    return [{k: v for k, v in line.items() if k != "time"} for line in read_metrics(out / "metrics.jsonl")]


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_a_run_leaves_metrics_artifact_and_state(whole, config, small):
    out, score = whole
    lines = untimed(out)
    assert [line["step"] for line in lines] == [256, 512, 768, 1024]
    assert "policy_loss" not in lines[0] and all("policy_loss" in line for line in lines[1:])
    assert [("track/success" in line) for line in lines] == [False, True, False, True]
    assert load_artifact(out).kind == "tokenizer"
    assert load_state(out / "state.safetensors")[1]["progress"]["samples"] == 1024
    assert score.names == ("wave", "sweep")


def test_it_returns_the_best_not_the_last(whole, small, standing, config):
    out, score = whole
    kept = MotionTokenizer.from_pretrained(out)
    again = track(kept, standing, future=kept.config.future, episodes=config.eval_episodes, seed=JUDGE)
    assert again.to_json() == score.to_json()


def test_it_may_leave_the_last(config, student, standing, tmp_path):
    score = train_ppo(student, standing, replace(config, keep="last"), tmp_path, quiet=True)
    assert same(MotionTokenizer.from_pretrained(tmp_path).state_dict(), student.state_dict())
    line = [line for line in read_metrics(tmp_path / "metrics.jsonl") if "track/success" in line][-1]
    assert line["track/mpjpe_mm"] == pytest.approx(score.mpjpe_mm.mean())
    tensors = load_state(tmp_path / "state.safetensors")[0]
    last = {name[11:]: value for name, value in tensors.items() if name.startswith("tree.actor.")}
    assert same(last, student.state_dict())


def test_a_resumed_run_is_the_unbroken_one(half, whole, config, small, standing):
    out, score = whole
    assert load_state(half / "state.safetensors")[1]["progress"]["samples"] == 512
    fresh = new_tokenizer(small.tokenizer, standing, 5)  # its weights come from the state, the anchor's too
    resumed = train_ppo(fresh, standing, config, half, quiet=True)
    assert resumed.to_json() == score.to_json()
    (tensors, meta), (expected, expected_meta) = (load_state(folder / "state.safetensors") for folder in (half, out))
    assert same(tensors, expected) and meta == expected_meta
    assert untimed(half) == untimed(out)
    assert load_artifact(half).hash == load_artifact(out).hash
    assert same(fresh.state_dict(), MotionTokenizer.from_pretrained(out).state_dict())


def test_leniency_ends_episodes_later_at_first(config, student, standing, tmp_path, monkeypatch):
    settings, real = [], training.collect
    monkeypatch.setattr(
        training, "collect", lambda world, *a, **k: settings.append(world.task.config) or real(world, *a, **k)
    )
    lenient = replace(config, failure=Failure(largest=0.6, mean=0.3, slack=0.1), leniency=2.0, from_start=0.2)
    train_ppo(student, standing, lenient, tmp_path, quiet=True)
    limits = [setting.failure for setting in settings]
    np.testing.assert_allclose([limit.largest for limit in limits], [1.2, 1.05, 0.9, 0.75])
    np.testing.assert_allclose([limit.mean for limit in limits], [0.6, 0.525, 0.45, 0.375])
    assert {limit.slack for limit in limits} == {0.1} and {setting.from_start for setting in settings} == {0.2}


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"leniency": 0.5}, "leniency must be at least 1, not 0.5"), ({"ema": 1.0}, "ema must be below 1, not 1.0; at 1")],
)
def test_a_stage_that_makes_no_sense_is_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        PPOStage(**settings)


def test_threads_change_nothing(whole, config, student, standing, tmp_path):
    out, _ = whole
    train_ppo(student, standing, config, tmp_path / "two", threads=2, quiet=True)
    assert untimed(tmp_path / "two") == untimed(out)


def test_when_nothing_better_follows_a_resume_the_kept_score_is_returned(half, config, student, standing, monkeypatch):
    kept, real = load_artifact(half).hash, train.track
    monkeypatch.setattr(train, "track", lambda *a, **k: replace(real(*a, **k), mpjpe_mm=np.full(2, 9e9)))
    score = train_ppo(student, standing, config, half, quiet=True)
    assert load_artifact(half).hash == kept
    again = real(student, standing, future=student.config.future, episodes=config.eval_episodes, seed=JUDGE)
    assert score.to_json() == again.to_json()
    assert load_state(half / "state.safetensors")[1]["progress"]["stale"] == 1


def test_a_finished_run_returns_at_once(whole, config, student, standing, monkeypatch):
    out, score = whole
    before = {path: path.read_bytes() for path in out.iterdir() if path.is_file()}
    no_training(monkeypatch)
    assert train_ppo(student, standing, config, out, quiet=True).to_json() == score.to_json()
    assert {path: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    assert same(student.state_dict(), MotionTokenizer.from_pretrained(out).state_dict())


@pytest.mark.parametrize("stop", [{"stop_mpjpe_mm": 1e9}, {"stop_mpjpe_mm": -1.0, "patience": 0}])
def test_a_run_that_ended_early_stays_ended(config, student, standing, tmp_path, monkeypatch, stop):
    early = replace(config, stop_success=0.0, **stop)
    score = train_ppo(student, standing, early, tmp_path, quiet=True)
    assert untimed(tmp_path)[-1]["step"] == 512
    no_training(monkeypatch)
    assert train_ppo(student, standing, early, tmp_path, quiet=True).to_json() == score.to_json()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: {"config": replace(c, ppo=replace(c.ppo, lr=5e-4))}, "stage.ppo.lr: 0.0004 -> 0.0005"),
        (lambda c: {"seed": 7}, "seed: 0 -> 7"),
        (lambda c: {"actor": {"activation": "relu"}}, "tokenizer.activation: silu -> relu"),
        (lambda c: {"table": ["wave", "other"]}, "clips: ['wave', 'sweep'] -> ['wave', 'other']"),
    ],
)
def test_a_changed_run_is_refused(whole, config, small, standing, wave, change, message):
    out, _ = whole
    changed, table = change(config), standing
    if "table" in changed:
        table = ReferenceTable(ClipLibrary.of([wave(name) for name in changed["table"]]))
    actor = new_tokenizer(replace(small.tokenizer, **changed.get("actor", {})), table, 0)
    with pytest.raises(CheckpointError, match=re.escape(message)) as error:
        train_ppo(actor, table, changed.get("config", config), out, seed=changed.get("seed", 0), quiet=True)
    assert str(out / "state.safetensors") in str(error.value) and "choose another --out" in str(error.value)


def test_a_state_from_before_a_setting_existed_goes_on(whole, config, student, standing, tmp_path, monkeypatch):
    tensors, meta = load_state(whole[0] / "state.safetensors")
    del meta["identity"]["stage"]["patience"]
    save_state(tmp_path / "state.safetensors", tensors, meta)
    student.save_pretrained(tmp_path, "")
    no_training(monkeypatch)
    train_ppo(student, standing, config, tmp_path, quiet=True)
    with pytest.raises(CheckpointError, match=r"stage\.patience: 1000 -> 3"):
        train_ppo(student, standing, replace(config, patience=3), tmp_path, quiet=True)


def test_parents_are_kept_and_a_state_made_from_others_is_refused(whole, config, student, standing, tmp_path, cut_off):
    def run(parents):
        train_ppo(student, standing, config, tmp_path / "out", parents=parents, quiet=True)

    cut_off(train, 2, lambda: run({"distill": "a" * 64}))
    assert load_artifact(tmp_path / "out").parents == {"distill": "a" * 64} and load_artifact(whole[0]).parents == {}
    for parents, change in (({"distill": "b" * 64}, f"distill {'a' * 12} -> {'b' * 12}"), ({}, f"{'a' * 12} -> none")):
        with pytest.raises(
            CheckpointError, match=f"made from other artifacts: .*{change}. Remove .*out to make it anew"
        ):
            run(parents)
    run({"distill": "a" * 64})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "samples must be at least 1, not 0; to leave the stage out, take its name from stages"),
        ({"rows": 0}, "rows must be at least 1, not 0"),
        ({"eval_every": 0}, "eval_every must be at least 1, not 0; give as many as samples"),
        ({"eval_episodes": 0}, "eval_episodes must be at least 1, not 0"),
        ({"critic_warmup": -1}, "critic_warmup must be at least 0, not -1; 0 is none"),
    ],
)
def test_a_stage_that_cannot_run_is_refused(change, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        PPOStage(**change)


def test_a_loss_that_is_not_finite_stops_the_run(half, config, student, wave):
    table = ReferenceTable(ClipLibrary.of([wave("wave"), wave("sweep", reach=-0.8)]))
    table.body.linear[:] = np.nan  # the reward's velocity term is not a number
    before = (half / "state.safetensors").read_bytes()
    with pytest.raises(FloatingPointError, match=r"the last good state in .* is untouched"):
        train_ppo(student, table, config, half, quiet=True)
    assert (half / "state.safetensors").read_bytes() == before
    tensors, _ = load_state(half / "bad_rollout.safetensors")
    assert torch.isnan(tensors["rewards"]).any() and tensors["obs"].shape[:2] == (8, 32)
    assert len(untimed(half)) == 2


def test_while_the_critic_warms_up_a_policy_that_was_trained_stays(config, student, standing, tmp_path):
    student.observe(torch.randn(64, sum(student.sizes.values())))
    before = {name: value.clone() for name, value in student.state_dict().items()}
    train_ppo(student, standing, replace(config, critic_warmup=9), tmp_path, quiet=True)
    assert same(student.state_dict(), before)


def test_a_stage_trains_in_the_tokenizers_scene():
    scene = SceneConfig(control_hz=60, substeps=2)
    assert in_scene(EnvConfig(push=1.0), scene) == EnvConfig(push=1.0, scene=scene)
    assert in_scene(EnvConfig(scene=scene), scene).scene == scene
    with pytest.raises(ConfigError, match=re.escape("env.scene differs from tokenizer.scene (control_hz: 30 -> 60")):
        in_scene(EnvConfig(scene=scene), SceneConfig())


def test_the_cards_and_the_state_are_plain(whole, config, student, standing, tmp_path):
    train_ppo(student, standing, config, tmp_path, quiet=True, card=lambda score: f"# {score.names[0]}")
    assert (tmp_path / "README.md").read_text() == "# wave"
    json.dumps(load_state(tmp_path / "state.safetensors")[1])
