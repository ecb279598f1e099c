import inspect
import json

import pytest

from kinetok import presets
from kinetok.config import ConfigError, from_dict, override, pick, to_dict
from kinetok.tokenizers import TokenLayout

TABLES = {name: table for name, table in vars(presets).items() if name.isupper() and isinstance(table, dict)}
ALL = [pytest.param(build, id=f"{table}-{name}") for table, rows in TABLES.items() for name, build in rows.items()]


def test_the_tables_hold_every_preset():
    listed = {build for table in TABLES.values() for build in table.values()}
    written = {
        value
        for name, value in vars(presets).items()
        if inspect.isfunction(value) and value.__module__ == presets.__name__ and not name.startswith("_")
    }
    assert listed == written and all(build.__doc__ for build in listed)
    assert all("tiny" in table for table in TABLES.values())


@pytest.mark.parametrize("build", ALL)
def test_it_builds_and_round_trips(build):
    config = build()
    assert from_dict(type(config), json.loads(json.dumps(to_dict(config)))) == config == build()


@pytest.mark.parametrize("build", ALL)
def test_a_misspelt_key_names_the_nearest(build):
    config = build()
    key = next(iter(to_dict(config)))
    with pytest.raises(ConfigError, match=f"did you mean '{key}'"):
        override(config, [f"{key}x=1"])


@pytest.mark.parametrize("name", presets.FIT)
def test_the_student_has_tokens_unless_it_is_a_teacher(name):
    config = presets.FIT[name]()
    quantizer = config.tokenizer.quantizer
    if name in ("generalist", "robust"):
        assert quantizer.kind == "continuous" and "teacher" not in config.stages
    else:
        layout = TokenLayout.grouped(quantizer.dim, quantizer.levels, config.tokenizer.scalars)
        assert layout.vocabulary < 100_000
    assert config.teacher.rows * config.teacher.ppo.horizon >= config.teacher.ppo.minibatch


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("teacher.sampels=3", "did you mean 'samples'"),
        ("teacher.ppo.lrr=0.1", "did you mean 'lr'"),
        ("tokenizer.quantizer.level=5", "did you mean 'levels'"),
        ("tokenizer.quantizer.kind=fsk", "did you mean 'fsq'"),
        ("techer.samples=3", "did you mean 'teacher'"),
        ("teacher.samples=many", "expected int, not 'many'"),
        ("teacher.samples", "write key=value"),
    ],
)
def test_a_wrong_setting(assignment, message):
    with pytest.raises(ConfigError, match=message):
        override(presets.FIT["tiny"](), [assignment])


def test_settings_reach_the_leaves():
    config = override(
        presets.FIT["one-clip"](),
        ["teacher.samples=1500000", "tokenizer.quantizer.levels=5", "ppo.log_std=-3,-3.5", "stages=ppo"],
    )
    assert config.teacher.samples == 1_500_000 and config.tokenizer.quantizer.levels == 5
    assert config.ppo.log_std == (-3.0, -3.5) and config.stages == ("ppo",)


def test_an_unknown_preset_names_the_nearest():
    with pytest.raises(ConfigError, match=r"unknown preset 'one_clip'; one of: one-clip.*did you mean 'one-clip'"):
        pick(presets.FIT, "one_clip", "preset")


@pytest.mark.parametrize("name", presets.FINETUNE)
def test_a_skill_draws_as_the_paper_does_or_as_was_measured_and_is_judged_while_it_trains(name):
    config = presets.FINETUNE[name]()
    drawn = {"laptop": (0.97, 0.8), "gpu": (0.97, 0.8)}.get(name, (0.9, 1.0))  # docs/log.md; GPC table 12
    assert (config.policy.top_p, config.policy.temperature) == drawn
    assert config.eval_every <= config.samples and config.eval_seconds * 30 >= 1
    assert config.rows * config.ppo.horizon >= config.ppo.minibatch
    assert config.critic_warmup * config.rows * config.ppo.horizon < config.samples


def test_the_papers_skill_is_the_papers():
    adapter = presets.FINETUNE["paper"]().adapter
    assert (adapter.kind, adapter.rank, adapter.alpha) == ("cola", 64, 128.0)


def test_settings_of_a_skill_reach_the_members_of_a_union():
    config = override(
        presets.FINETUNE["laptop"](),
        ["adapter.kind=dora", "adapter.rank=4", "adapter.targets=qkv,proj", "task.kind=path", "task.speed=0.5,1"],
    )
    assert (config.adapter.kind, config.adapter.rank, config.adapter.targets) == ("dora", 4, ("qkv", "proj"))
    assert config.task.kind == "path" and config.task.speed == (0.5, 1.0)
    for assignment, message in (
        ("adapter.kind=cora", "did you mean '(cola|dora|lora)'"),
        ("adapter.rnk=3", "did you mean 'rank'"),
        ("task.kind=stering", "did you mean 'steering'"),
        ("policy.entrpy=1", "did you mean 'entropy'"),
        ("policy.top_p=0", "top_p must lie in"),
        ("policy.least=0", "least must be at least 1"),
        ("sft.iterations=0", "iterations must be at least 1"),
        ("methods=rl,sft", "sft before rl"),
    ):
        with pytest.raises(ConfigError, match=message):
            override(config, [assignment])
