"""finetune.py: the whole chain on a tiny prior, warm starts, resuming bit for bit, and what it refuses."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made import make_prior

from kinetok.adapters import ADAPTERS, CoLAConfig, LoRAConfig
from kinetok.adapters import finetune as room
from kinetok.adapters.adapted import Adapted, fingerprint, parameters_of
from kinetok.adapters.finetune import FinetuneConfig, finetune, reshaped
from kinetok.adapters.rlft import TokenPolicyConfig, play
from kinetok.adapters.skill import Skill
from kinetok.checkpoint import ADAPTER, CheckpointError, load_artifact, load_state, save_artifact
from kinetok.config import ConfigError, override
from kinetok.evaluate import evaluate_task
from kinetok.gpt.controller import Prior
from kinetok.logger import read_metrics
from kinetok.motion.character import Character
from kinetok.presets import FINETUNE
from kinetok.rl.ppo import PPOConfig
from kinetok.sim.env import EnvConfig
from kinetok.sim.tasks import TASKS, PathConfig, SteeringConfig, TargetConfig

TINY = replace(
    FINETUNE["tiny"](),
    adapter=LoRAConfig(rank=2, alpha=4.0, hidden=8, dropout=0.2),
    samples=128,
    rows=8,
    eval_every=64,
    eval_episodes=2,
    eval_seconds=0.2,
    ppo=PPOConfig(horizon=4, minibatch=16, epochs=1),
    env=EnvConfig(episode_seconds=0.3, reset_noise=0.02, push=0.5),
    policy=TokenPolicyConfig(kl=0.05, entropy=0.01),
)
BOTH = replace(
    TINY, methods=("sft", "rl"), sft=replace(TINY.sft, samples=160, rows=8, iterations=4, batch=16, eval_every=2)
)


def run(models, out, config=TINY, **options):
    prior = Prior.from_pretrained(models / "prior")
    return finetune(prior, config, out, **({"base": models / "prior", "threads": 1, "quiet": True} | options))


@pytest.fixture(scope="module")
def whole(models, clips, tmp_path_factory) -> Path:
    """A run of both methods that was never interrupted."""
    out = tmp_path_factory.mktemp("runs") / "both"
    run(models, out, BOTH, clips=clips)
    return out


@pytest.fixture(scope="module")
def plain(models, tmp_path_factory) -> Path:
    """A run of reinforcement learning alone."""
    out = tmp_path_factory.mktemp("runs") / "plain"
    run(models, out)
    return out


def weights(path) -> dict[str, torch.Tensor]:
    return load_artifact(path, "adapter", ADAPTER).tensors


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def untimed(out):
    return [{k: v for k, v in line.items() if k != "time"} for line in read_metrics(out / "metrics.jsonl")]


def contents(out):
    return {path: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()} if out.exists() else None


def test_a_run_leaves_a_skill_for_every_method(whole, models, clips):
    lines = untimed(whole)
    assert [line["step"] for line in lines] == [32, 64, 96, 128]
    assert [("eval/return" in line) for line in lines] == [False, True, False, True]
    assert {"policy_loss", "value_loss", "kl", "kl_prior", "entropy", "lr"} <= lines[1].keys()
    prior = fingerprint(Prior.from_pretrained(models / "prior").gpt)
    style, skill = (load_artifact(path, "adapter", ADAPTER) for path in (whole / "sft", whole))
    assert style.parents == {"gpt": prior} and skill.parents == {"gpt": prior, "skill": style.hash}
    card = (whole / "README.md").read_text()
    assert f"from the adapter {style.hash[:12]}" in card and "| return |" in card and "target" in card
    assert "held_out/cross_entropy" in (whole / "sft" / "README.md").read_text()
    noted = json.loads((whole / "adapter_config.json").read_text())["config"]["skill"]["prior"]
    assert not Path(noted).is_absolute() and (whole / noted).samefile(models / "prior")


def test_the_state_holds_the_adapter_and_not_the_prior(whole):
    names = load_state(whole / "state.safetensors")[0]
    assert not any("base.embed" in name or "base.blocks" in name for name in names)


def test_the_skill_is_found_with_its_prior_and_played(whole, models):
    skill = Skill.from_pretrained(whole)
    assert skill.task == BOTH.task and skill.policy == BOTH.policy and skill.adapted.config == BOTH.adapter
    assert same(skill.adapted.adapter_state(), weights(whole))
    played = play(skill.controller(3), skill.task, skill.prior, episodes=2, seconds=1.0, seed=3, threads=1)
    told = evaluate_task(whole, episodes=2, seconds=1.0, seed=3, threads=1)
    assert {name: told[name] for name in played.score.measures} == played.score.measures
    assert told["task"] == "target" and told["seed"] == 3 and told["episodes"] == 2
    given = Skill.from_pretrained(whole, models / "prior", models / "tokenizer")
    again = play(given.controller(3), given.task, given.prior, episodes=2, seconds=1.0, seed=3, threads=2)
    assert again.score == played.score
    greedy = Skill.from_pretrained(whole, skill.prior).controller(None)
    obs = torch.randn(2, skill.prior.gpt.config.state_dim + 4)
    assert torch.equal(greedy(obs), greedy(obs))


def test_the_best_evaluation_is_kept(models, tmp_path, monkeypatch):
    merits, real = iter([2.0, 1.0]), room.play

    def judged(*args, **options):
        played = real(*args, **options)
        measures = played.score.measures | {"reward": next(merits)}
        return replace(played, score=replace(played.score, measures=measures))

    monkeypatch.setattr(room, "play", judged)
    skill = run(models, tmp_path)
    assert load_state(tmp_path / "state.safetensors")[1]["progress"]["best"] == 2.0
    assert "| reward | 2.000 |" in (tmp_path / "README.md").read_text()
    last = load_state(tmp_path / "state.safetensors")[0]
    name = next(name for name in weights(tmp_path) if "lora_B" in name)
    kept, trained = skill.adapted.adapter_state()[name], last[f"tree.adapter.{name}"]
    assert torch.equal(kept, weights(tmp_path)[name]) and not torch.equal(kept, trained)


@pytest.mark.parametrize("cut_in", ["sft", "rl"])
def test_a_resumed_run_is_the_unbroken_one(whole, models, clips, tmp_path, monkeypatch, cut_in):
    # Cut off in the second evaluation of the method.
    name = "skill_card" if cut_in == "sft" else "play"
    real, calls = getattr(room, name), []

    def cut(*args, **options):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args, **options)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(room, name, cut)
        run(models, tmp_path, BOTH, clips=clips)
    assert (tmp_path / "state.safetensors").exists() == (cut_in == "rl")
    torch.manual_seed(77)
    np.random.seed(77)
    run(models, tmp_path, BOTH, clips=clips)
    for place in ("sft", "."):
        (tensors, meta), (expected, expected_meta) = (
            load_state(out / place / "state.safetensors") for out in (tmp_path, whole)
        )
        assert same(tensors, expected) and meta == expected_meta
        assert untimed(tmp_path / place) == untimed(whole / place)
        assert same(weights(tmp_path / place), weights(whole / place))


def test_a_finished_run_returns_at_once(whole, models, clips, monkeypatch):
    before = {path: data for path, data in contents(whole).items() if "tensorboard" not in path.parts}
    monkeypatch.setattr(room, "play", None)
    monkeypatch.setattr("kinetok.adapters.sft.record", None)
    skill = run(models, whole, BOTH, clips=clips)
    assert {path: path.read_bytes() for path in before} == before
    assert same(skill.adapted.adapter_state(), weights(whole))


def test_a_longer_run_goes_on(plain, models, tmp_path):
    run(models, tmp_path, replace(TINY, samples=64))
    run(models, tmp_path)
    assert untimed(tmp_path) == untimed(plain) and same(weights(tmp_path), weights(plain))


def test_how_many_episodes_judge_it_changes_nothing_but_the_judgement(plain, models, tmp_path):
    run(models, tmp_path, replace(TINY, eval_episodes=3, eval_seconds=0.3))
    for a, b in zip(untimed(tmp_path), untimed(plain), strict=True):
        assert {k: v for k, v in a.items() if "eval/" not in k} == {k: v for k, v in b.items() if "eval/" not in k}
    name = next(name for name in load_state(plain / "state.safetensors")[0] if "lora_B" in name)
    assert torch.equal(*(load_state(out / "state.safetensors")[0][name] for out in (tmp_path, plain)))


@pytest.mark.parametrize(
    ("kind", "task"), [*((kind, "steering") for kind in ADAPTERS), *(("cola", task) for task in ("target", "path"))]
)
def test_every_adapter_runs_and_every_task(models, tmp_path, kind, task):
    config = replace(reshaped(TINY, task=task, adapter=kind), samples=64, env=EnvConfig(episode_seconds=0.3))
    skill = run(models, tmp_path, config)
    assert skill.adapted.config.kind == kind and skill.task.kind == task
    width = {"target": 4, "steering": 4, "path": 20}[task]
    assert skill.adapted.cond_dim == width == Skill.from_pretrained(tmp_path).adapted.cond_dim
    played = play(skill.controller(0), skill.task, skill.prior, episodes=1, seconds=0.2, threads=1)
    assert np.isfinite(played.score.merit)


def test_another_adapter_keeps_what_it_has_in_common():
    config = reshaped(TINY, task="steering", adapter="cola")
    assert config.adapter == CoLAConfig(rank=2, alpha=4.0, hidden=8) and config.task == SteeringConfig()
    assert reshaped(TINY, task="target", adapter="lora") is TINY
    changed = override(TINY, ["adapter.kind=cola", "adapter.rank=8", "task.near=0.3", "policy.kl=0.1"])
    assert changed.adapter == CoLAConfig(rank=8) and changed.task == TargetConfig(near=0.3)
    assert changed.policy == TokenPolicyConfig(kl=0.1, entropy=0.01)


def test_the_count_of_parameters_is_said_first(models, tmp_path, capsys):
    skill = run(models, tmp_path, replace(TINY, samples=32, eval_every=32), quiet=False)
    count, frozen, share = parameters_of(skill.adapted)
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == f"lora adapter of {count:,} parameters, {share:.2%} of the {frozen:,} that stay frozen"
    assert last.startswith("best evaluation: target_distance_m ") and last.endswith(str(tmp_path))


def test_it_may_begin_with_another_skill(plain, models, tmp_path):
    config = replace(TINY, task=TargetConfig(distance=(2.0, 3.0)), samples=32, eval_every=32)
    skill = run(models, tmp_path, config, start=plain)
    artifact = load_artifact(tmp_path, "adapter", ADAPTER)
    assert artifact.parents["skill"] == load_artifact(plain, "adapter", ADAPTER).hash
    # One iteration, which learns nothing yet: adapter and statistics are those it began with.
    assert same(artifact.tensors, weights(plain)) and skill.task.distance == (2.0, 3.0)
    run(models, tmp_path, replace(config, samples=64), start=plain)
    assert not same(load_state(tmp_path / "state.safetensors")[0], weights(plain))


def test_after_examples_the_task_finds_the_style_as_it_was(whole, models):
    prior = Prior.from_pretrained(models / "prior")
    style = Adapted.from_pretrained(whole / "sft", prior.gpt)
    state, tokens = torch.randn(4, prior.gpt.config.state_dim), torch.randint(125, (4, 2))
    asked = style(state, torch.zeros(4, 4), tokens)
    for statistics in (torch.randn(50, 4), 5.0 + torch.randn(500, 4)):
        style.observe(statistics)
        assert torch.equal(style(state, torch.randn(4, 4), tokens), asked)
    assert not torch.allclose(prior.gpt(state, tokens), asked)


def g1(clips):
    return [replace(clips[0], name="wave", character="g1", qpos=np.tile(Character.load("g1").model.qpos0, (9, 1)))]


WRONG = {  # config; options from the clips and a finished run; message
    "no clips": (BOTH, lambda clips, skill: {}, "supervised fine-tuning needs example clips: --clips PATH"),
    "clips for nothing": (
        TINY,
        lambda clips, skill: {"clips": clips},
        "reinforcement learning uses no clips; add --method sft or hindsight",
    ),
    "clips of another body": (
        BOTH,
        lambda clips, skill: {"clips": g1(clips)},
        "clip 'wave' is of 'g1', the prior moves 'humanoid'; retarget it first",
    ),
    "target": (
        replace(TINY, adapter=LoRAConfig(targets=("qvk",))),
        lambda clips, skill: {},
        "no linear layer is called 'qvk'",
    ),
    "another scene": (
        override(TINY, ["env.scene.control_hz=60"]),
        lambda clips, skill: {},
        "env.scene differs from tokenizer.scene (control_hz: 30 -> 60)",
    ),
    "nobody stands": (
        override(TINY, ["task.fall_height=5"]),
        lambda clips, skill: {},
        "none of the prior's 8 start states has its root above fall_height 5.0 m",
    ),
    "start of another shape": (
        override(TINY, ["adapter.rank=3", "adapter.dropout=0"]),
        lambda clips, skill: {"start": skill},
        "holds an adapter of another shape: adapter.rank: 2 -> 3; adapter.dropout: 0.2 -> 0.0",
    ),
    "start of another width": (
        replace(TINY, task=PathConfig()),
        lambda clips, skill: {"start": skill},
        "another shape: cond_dim: 4 -> 20. Ask for the same adapter, and for a task whose observation is as wide",
    ),
    "start and examples": (BOTH, lambda clips, skill: {"clips": clips, "start": skill}, "--from needs --method rl"),
    "no start": (TINY, lambda clips, skill: {"start": "nowhere"}, "there is no directory nowhere"),
    "rebase what": (TINY, lambda clips, skill: {"rebase": True}, "--rebase takes the skill of --from over to another"),
    "start is a prior": (TINY, lambda clips, skill: {"start": "humanoid-gpt"}, "humanoid-gpt"),
}


@pytest.mark.parametrize(("config", "options", "message"), WRONG.values(), ids=WRONG)
def test_what_cannot_be_done_is_refused_before_anything_is_written(
    models, plain, clips, tmp_path, config, options, message
):
    with pytest.raises((ValueError, CheckpointError), match=re.escape(message)):
        run(models, tmp_path / "new" / "out", config, **options(clips, plain))
    assert not (tmp_path / "new").exists()


def test_the_adapter_of_another_prior_is_refused_by_both_hashes(models, plain, table, tmp_path):
    other = make_prior(tmp_path, table)
    with torch.no_grad():
        other.gpt.norm.weight.add_(1.0)
    other.save_pretrained(tmp_path / "prior", "another")
    hashes = [fingerprint(Prior.from_pretrained(path / "prior").gpt)[:12] for path in (models, tmp_path)]
    message = f"{plain} was made with the gpt {hashes[0]}, but {tmp_path / 'prior'} is {hashes[1]}"
    for refused in (
        lambda: Skill.from_pretrained(plain, tmp_path / "prior"),
        lambda: finetune(other, TINY, tmp_path / "out", base=tmp_path / "prior", start=plain),
        lambda: evaluate_task(plain, tmp_path / "prior"),
    ):
        with pytest.raises(CheckpointError, match=re.escape(message)):
            refused()
    assert not (tmp_path / "out").exists()
    old = Adapted.from_pretrained(plain, Prior.from_pretrained(models / "prior").gpt).adapter_state()
    nothing = replace(TINY, critic_warmup=100)  # no update of the adapter: what comes out is what was taken over
    skill = finetune(other, nothing, tmp_path / "out", base=tmp_path / "prior", start=plain, rebase=True, threads=1)
    assert skill.adapted.adapter_state().keys() == old.keys()
    moved = [name for name, tensor in skill.adapted.adapter_state().items() if not torch.equal(tensor, old[name])]
    assert all(name.startswith("conditioner.norm.") for name in moved)  # what it has seen of the task goes on
    assert Skill.from_pretrained(tmp_path / "out").prior.gpt.norm.weight.equal(other.gpt.norm.weight)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: {"config": replace(c, ppo=replace(c.ppo, lr=5e-4))}, "stage.ppo.lr: 0.0004 -> 0.0005"),
        (lambda c: {"config": replace(c, task=SteeringConfig())}, "stage.task.kind: target -> steering"),
        (lambda c: {"config": override(c, ["adapter.rank=3"])}, "stage.adapter.rank: 2 -> 3"),
        (lambda c: {"seed": 4}, "seed: 0 -> 4"),
        (lambda c: {"config": replace(c, samples=64)}, "stage.samples: 128 -> 64"),
    ],
)
def test_going_on_with_other_settings_is_refused(plain, models, change, message):
    before = contents(plain)
    with pytest.raises(CheckpointError, match=re.escape(message)) as error:
        run(models, plain, **change(TINY))
    assert str(plain / "state.safetensors") in str(error.value) and contents(plain) == before


def test_the_other_method_in_the_same_place_is_refused(plain, models, clips, tmp_path):
    sft = replace(BOTH, methods=("sft",))
    with pytest.raises(CheckpointError, match="is the state of another kind of run: it has no sft; choose another --o"):
        run(models, plain, sft, clips=clips)
    run(models, tmp_path, sft, clips=clips)
    assert load_artifact(tmp_path, "adapter", ADAPTER).parents.keys() == {"gpt"}
    with pytest.raises(CheckpointError, match="is the state of another kind of run: it has no stage"):
        run(models, tmp_path)
    with pytest.raises(CheckpointError, match=r"task\.kind: target -> steering"):
        run(models, tmp_path, replace(sft, task=SteeringConfig()), clips=clips)


def test_a_foreign_place_is_left_alone(models, plain, tmp_path):
    (tmp_path / "README.md").write_text("mine")
    (tmp_path / "file").write_text("mine")
    save_artifact(tmp_path / "prior", kind="prior", config={}, tensors={"w": torch.ones(2)}, card="#")
    before = contents(tmp_path)
    for out, message in (
        (tmp_path, "holds a README.md that kinetok did not write"),
        (tmp_path / "prior", "holds a 'prior', which a 'adapter' would replace"),
        (tmp_path / "file", "is a file; an artifact is a directory"),
    ):
        with pytest.raises(CheckpointError, match=message):
            run(models, out)
    with pytest.raises(OSError, match="file"):
        run(models, tmp_path / "file" / "run")
    with pytest.raises(ConfigError, match="--from and --out are the same folder"):
        run(models, plain, start=plain)
    assert contents(tmp_path) == before


def test_a_reward_that_is_not_finite_stops_the_run_and_leaves_the_last_good_one(plain, models, tmp_path, monkeypatch):
    run(models, tmp_path, replace(TINY, samples=64))
    before = {path: data for path, data in contents(tmp_path).items() if path.suffix != ".jsonl"}
    real = TASKS["target"][1].reward

    def spoilt(task, body):
        reward, terms = real(task, body)
        return np.where(np.arange(len(reward)) == 1, np.nan, reward), terms

    monkeypatch.setattr(TASKS["target"][1], "reward", spoilt)
    with pytest.raises(FloatingPointError, match=r"4 of 32 rewards are not finite; training stopped.*untouched"):
        run(models, tmp_path)
    assert before.items() <= contents(tmp_path).items() and (tmp_path / "bad_rollout.safetensors").exists()
    monkeypatch.undo()
    run(models, tmp_path)
    assert same(weights(tmp_path), weights(plain))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"methods": ("sfl",)}, "unknown method 'sfl'; did you mean 'sft'?; methods: sft, "),
        ({"methods": ("rl", "sft")}, "methods rl, sft: name each once, sft before rl"),
        ({"methods": ()}, "methods (none): name each once"),
        ({"rows": 0}, "rows must be at least 1, not 0"),
        ({"eval_seconds": 0.0}, "eval_seconds must be at least 0.1, not 0.0"),
    ],
)
def test_settings_that_cannot_be(settings, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        FinetuneConfig(**settings)


def test_kinds_that_are_not_known_name_the_nearest():
    with pytest.raises(ConfigError, match=r"unknown task 'steer'; one of: target, .*did you mean 'steering'"):
        reshaped(TINY, task="steer", adapter="lora")
    with pytest.raises(ConfigError, match=r"unknown adapter 'cora'; one of: lora, .*did you mean 'cola'|'lora'"):
        reshaped(TINY, task="target", adapter="cora")
