import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from kinetok.checkpoint import CheckpointError, load_artifact, load_state
from kinetok.config import ConfigError
from kinetok.logger import read_metrics
from kinetok.motion.library import ClipLibrary
from kinetok.rl.training import JUDGE
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.tracking import Failure, ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers import distill as module
from kinetok.tokenizers.distill import DistillStage, _View, distill
from kinetok.tokenizers.fit import new_tokenizer
from kinetok.tokenizers.tokenizer import MotionTokenizer
from kinetok.tokenizers.track import track


@pytest.fixture(scope="module")
def teachers(small, standing) -> list[MotionTokenizer]:
    """Experts that nobody trained: fixed maps from observations to targets, one per clip."""
    made = [new_tokenizer(small.teacher_tokenizer, standing, seed) for seed in (3, 4)]
    for teacher in made:
        torch.nn.init.normal_(teacher.decoder[-1].weight, std=0.05, generator=torch.Generator().manual_seed(3))
    return made


@pytest.fixture(scope="module")
def config(small) -> DistillStage:
    """Forty steps, an evaluation every ten, and a state after every other evaluation."""
    env = EnvConfig(reset_noise=0.01, push=0.5, episode_seconds=0.5)
    return replace(small.distill, samples=40 * 32, eval_every=10 * 32, save_every=11 * 32, env=env)


@pytest.fixture(scope="module")
def whole(config, small, standing, teachers, tmp_path_factory):
    """One distillation that was never interrupted: its folder and its score."""
    out = tmp_path_factory.mktemp("whole")
    score = distill(new_tokenizer(small.tokenizer, standing, 0), teachers, standing, config, out, quiet=True)
    return out, score


def untimed(out) -> list[dict]:
    return [{k: v for k, v in line.items() if k != "time"} for line in read_metrics(out / "metrics.jsonl")]


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("bf16", [False, True])
def test_the_student_learns_what_the_teachers_do(student, teachers, standing, config, tmp_path, bf16):
    longer = replace(
        config, samples=100 * 32, eval_every=100 * 32, updates=3, minibatch=128, memory=3200, lr=3e-3, bf16=bf16
    )
    distill(student, teachers, standing, longer, tmp_path, quiet=True)
    errors = [line["label_rmse"] for line in untimed(tmp_path)]
    assert len(errors) == 5 and errors[-1] < 0.6 * errors[0]


def test_each_looks_as_far_ahead_as_it_does(small, student, teachers, standing, config, tmp_path):
    longer = replace(config, samples=100 * 32, eval_every=100 * 32, updates=3, minibatch=128, memory=3200, lr=3e-3)
    distill(student, [teachers[0], far(small, standing)], standing, longer, tmp_path, quiet=True)
    errors = [line["label_rmse"] for line in untimed(tmp_path)]
    assert errors[-1] < 0.8 * errors[0] and MotionTokenizer.from_pretrained(tmp_path).config.future == (1, 2, 5)


def test_a_resumed_run_is_the_unbroken_one(whole, config, small, student, teachers, standing, tmp_path, cut_off):
    out, score = whole
    cut_off(module, 3, lambda: distill(student, teachers, standing, config, tmp_path, quiet=True))
    assert load_state(tmp_path / "state.safetensors")[1]["step"] == 20
    fresh = new_tokenizer(small.tokenizer, standing, 5)  # its weights come from the state
    resumed = distill(fresh, teachers, standing, config, tmp_path, quiet=True)
    assert resumed.to_json() == score.to_json()
    (tensors, meta), (expected, expected_meta) = (
        load_state(folder / "state.safetensors") for folder in (tmp_path, out)
    )
    assert same(tensors, expected) and meta == expected_meta
    assert untimed(tmp_path) == untimed(out) and [line["step"] for line in untimed(out)] == [320, 640, 960, 1280]
    assert load_artifact(tmp_path).hash == load_artifact(out).hash


def test_an_average_of_the_weights_is_judged_and_resumed(
    config, small, standing, teachers, tmp_path, cut_off, monkeypatch
):
    steady, judged, real = replace(config, ema=0.9), [], module.track

    def track(student, *args, **kwargs):
        judged.append(next(student.parameters()).detach().clone())
        return real(student, *args, **kwargs)

    monkeypatch.setattr(module, "track", track)
    pupil = new_tokenizer(small.tokenizer, standing, 0)
    distill(pupil, teachers, standing, steady, tmp_path / "whole", quiet=True)
    state = load_state(tmp_path / "whole" / "state.safetensors")[0]
    first = next(name for name, _ in pupil.named_parameters())
    assert torch.equal(judged[-1], state["tree.average.0"])
    assert not torch.equal(judged[-1], state[f"tree.student.{first}"])
    pupil = new_tokenizer(small.tokenizer, standing, 0)
    cut_off(module, 3, lambda: distill(pupil, teachers, standing, steady, tmp_path / "cut", quiet=True))
    distill(pupil, teachers, standing, steady, tmp_path / "cut", quiet=True)
    assert same(load_state(tmp_path / "cut" / "state.safetensors")[0], state)
    assert load_artifact(tmp_path / "cut").hash == load_artifact(tmp_path / "whole").hash


def test_it_may_leave_the_last(config, student, teachers, standing, tmp_path):
    distill(student, teachers, standing, replace(config, keep="last"), tmp_path, quiet=True)
    tensors = load_state(tmp_path / "state.safetensors")[0]
    last = {name.split("student.")[1]: value for name, value in tensors.items() if ".student." in name}
    assert same(last, MotionTokenizer.from_pretrained(tmp_path).state_dict())


def test_it_returns_the_kept_student_and_its_score(whole, config, student, teachers, standing, monkeypatch):
    out, score = whole
    kept = MotionTokenizer.from_pretrained(out)
    again = track(kept, standing, future=kept.config.future, episodes=config.eval_episodes, seed=JUDGE)
    assert again.to_json() == score.to_json()

    def fail(*args, **kwargs):
        raise AssertionError("a finished run trains or evaluates")

    monkeypatch.setattr(module, "track", fail)
    monkeypatch.setattr(module, "_regress", fail)
    assert distill(student, teachers, standing, config, out, quiet=True).to_json() == score.to_json()
    assert same(student.state_dict(), kept.state_dict())


def test_when_nothing_better_follows_a_resume_the_kept_score_is_returned(
    config, student, teachers, standing, tmp_path, cut_off, monkeypatch
):
    cut_off(module, 3, lambda: distill(student, teachers, standing, config, tmp_path, quiet=True))
    kept, real = load_artifact(tmp_path).hash, module.track
    monkeypatch.setattr(module, "track", lambda *a, **k: replace(real(*a, **k), mpjpe_mm=np.full(2, 9e9)))
    score = distill(student, teachers, standing, config, tmp_path, quiet=True)
    assert load_artifact(tmp_path).hash == kept
    again = real(student, standing, future=student.config.future, episodes=config.eval_episodes, seed=JUDGE)
    assert score.to_json() == again.to_json()


@pytest.mark.parametrize("future", [(1, 2, 5), (5,), (5, 1)])
def test_a_teacher_sees_its_own_observation(small, standing, future):
    """The columns a view picks are, bit for bit, what a tracking task with the teacher's window observes."""
    teacher = new_tokenizer(replace(small.teacher_tokenizer, future=future), standing, 0)
    obs = {}
    for window in (small.tokenizer.future, future):
        task = Tracking(TrackingConfig(future=window), standing, rows=6)
        env = Env(EnvConfig(reset_noise=0.05), task, rows=6, threads=1, seed=1)
        env.reset()
        action = standing.target[:6] + 0.2
        obs[window] = [torch.from_numpy(env.step(action).obs) for _ in range(4)]
    view = _View(teacher, Tracking(TrackingConfig(future=small.tokenizer.future), standing, rows=6), False)
    for student_sees, teacher_sees in zip(obs[small.tokenizer.future], obs[future], strict=True):
        assert torch.equal(view.seen(student_sees), teacher_sees)
        with torch.no_grad():
            assert torch.equal(view.act(student_sees), teacher.act(teacher_sees)[0])


def test_every_clip_is_labelled_by_its_own_teacher(student, teachers, standing, config, tmp_path, monkeypatch):
    """With swapped teachers the same states get other labels, so the student learns another map."""
    short = replace(config, samples=20 * 32)
    weights = []
    for name, order in (("a", teachers), ("b", teachers[::-1]), ("c", teachers)):
        pupil = new_tokenizer(student.config, standing, 0)
        distill(pupil, order, standing, short, tmp_path / name, quiet=True)
        weights.append(pupil.state_dict())
    assert same(weights[0], weights[2]) and not same(weights[0], weights[1])


def test_all_its_episodes_may_begin_at_first_frames(student, teachers, standing, config, tmp_path, monkeypatch):
    def reset(env, **how):
        obs = real(env, **how)
        begun.append(env.task.frame - standing.first[env.task.clip])
        return obs

    begun, real = [], Env.reset
    monkeypatch.setattr(Env, "reset", reset)
    distill(student, teachers, standing, replace(config, samples=20 * 32, from_start=1.0), tmp_path, quiet=True)
    assert len(begun[0]) == 32 and not begun[0].any()


def test_a_changed_teacher_is_refused(config, student, teachers, standing, tmp_path, cut_off):
    def run(left, right):
        parents = {"teacher/wave": left * 64, "teacher/sweep": right * 64}
        distill(student, teachers, standing, config, tmp_path, parents=parents, quiet=True)

    cut_off(module, 3, lambda: run("a", "b"))
    message = (
        f"state.safetensors: this run was made from other artifacts: teacher/sweep {'b' * 12} -> {'c' * 12}. Remove"
    )
    with pytest.raises(CheckpointError, match=re.escape(message)):
        run("a", "c")
    run("a", "b")
    assert load_artifact(tmp_path).parents == {"teacher/wave": "a" * 64, "teacher/sweep": "b" * 64}


def test_a_clip_that_always_fails_leaves_the_others_their_share(student, teachers, wave, config, tmp_path):
    """The reference of the second clip is 9 m away: every episode there fails, of the first few do."""
    calm = replace(
        config, samples=100 * 32, eval_every=100 * 32, failure=Failure(mean=0.4), env=EnvConfig(episode_seconds=0.2)
    )
    table = ReferenceTable(ClipLibrary.of([wave("wave"), wave("lost")]))
    table.body.pos[table.first[1] :] += 9.0
    distill(student, teachers, table, calm, tmp_path, quiet=True)
    weights = json.loads(load_state(tmp_path / "state.safetensors")[1]["env"])["task"]["weights"]
    assert weights[1] == pytest.approx(calm.focus**0.5) and weights[0] == pytest.approx(calm.focus**-0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "samples must be at least 1, not 0"),
        ({"updates": 0}, "updates must be at least 1, not 0; without minibatches nothing is learned"),
        ({"memory": 255}, "memory must be at least 256, not 255"),
        ({"focus": 0.5}, "focus must be at least 1, not 0.5; 1 draws all clips alike"),
        ({"noise": -0.1}, "noise must be at least 0, not -0.1"),
    ],
)
def test_a_stage_that_cannot_run_is_refused(change, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        DistillStage(**change)


def far(small, standing) -> MotionTokenizer:
    return new_tokenizer(replace(small.teacher_tokenizer, future=(1, 30)), standing, 0)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda run, teachers, **_: run(teachers[:1]),
            ValueError,
            "2 clips need a teacher each (the same one may repeat), not 1",
        ),
        (
            lambda run, teachers, whole, config, **_: run(teachers, replace(config, noise=0.5), whole[0]),
            CheckpointError,
            "stage.noise: 0.02 -> 0.5",
        ),
    ],
)
def test_messages(call, error, message, whole, config, small, student, teachers, standing, tmp_path):
    def run(labels, stage=config, out=tmp_path / "out"):
        distill(student, labels, standing, stage, out, quiet=True)

    with pytest.raises(error, match=re.escape(message)):
        call(run=run, teachers=teachers, small=small, standing=standing, whole=whole, config=config)
    assert not (tmp_path / "out").exists()


def test_a_loss_that_is_not_finite_stops_and_keeps_the_state(
    config, small, student, teachers, standing, tmp_path, cut_off
):
    cut_off(module, 3, lambda: distill(student, teachers, standing, config, tmp_path, quiet=True))
    before = (tmp_path / "state.safetensors").read_bytes()
    broken = new_tokenizer(small.teacher_tokenizer, standing, 3)
    torch.nn.init.constant_(broken.decoder[-1].bias, float("nan"))
    with pytest.raises(FloatingPointError, match="distillation loss is nan"):
        distill(student, [broken, broken], standing, config, tmp_path, quiet=True)
    assert (tmp_path / "state.safetensors").read_bytes() == before
