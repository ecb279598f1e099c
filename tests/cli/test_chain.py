"""From a clip to a skill: each command eats the files of the one before."""

import json
from pathlib import Path

import numpy as np
import pytest

from kinetok.checkpoint import ADAPTER, load_artifact
from kinetok.motion.formats import read_clips
from kinetok.tokenizers.codec import TokenStream
from tests.cli.typed import kinetok


def test_fit_writes_every_stage_and_goes_on_where_it_was(run, clip):
    assert load_artifact(run).kind == "tokenizer"
    assert all(load_artifact(run / stage) for stage in ("teachers/wave", "distill", "ppo"))
    before = load_artifact(run).hash
    again = kinetok("tokenize", "fit", "--clips", clip, "--out", run, "--preset", "tiny", "--set", "ppo.samples=512")
    assert again.exit_code == 0 and load_artifact(run).hash == before
    changed = kinetok("tokenize", "fit", "--clips", clip, "--out", run, "--preset", "tiny", "--set", "ppo.samples=256")
    assert changed.exit_code == 1 and "stage.samples: 512 -> 256" in changed.output


def test_tokens_decode_to_the_motion_they_were_read_from(run, tokens, tmp_path):
    out = tmp_path / "deep" / "again.safetensors"
    result = kinetok("tokenize", "decode", tokens, "--tokenizer", run, "--out", out)
    assert result.output == f"wrote {out}: 16 frames at 30 fps\n"
    (motion,) = read_clips(out)
    assert motion.name == "wave" and motion.source == "simulated"
    assert np.abs(motion.qpos - TokenStream.load(tokens).simulated).max() < 1e-6  # a library keeps float32


def test_a_prior_is_trained_sampled_and_measured_from_the_files_before_it(run, clip, tmp_path):
    prior = tmp_path / "prior"
    result = kinetok("pretrain", "--tokenizer", run, "--clips", clip, "--out", prior, "--preset", "tiny")
    assert result.exit_code == 0, result.output
    result = kinetok("evaluate", "prior", "--prior", prior, "--episodes", 4, "--seconds", 1, "--json", "prior.json")
    assert result.exit_code == 0, result.output
    figures = json.loads(Path("prior.json").read_text())
    assert {"survival_rate", "seconds", "episodes", "apd_m", "accel_mps2", "jerk"} <= set(figures)
    assert figures["episodes"] == 4 and figures["seconds"] == 1
    result = kinetok("evaluate", "tracking", "--tokenizer", run, "--clips", clip, "--episodes", 2, "--json", "t.json")
    assert result.exit_code == 0, result.output
    figures = json.loads(Path("t.json").read_text())
    assert {"success_rate", "success_rate_mean_error", "mpjpe_mm", "clips", "seed", "episodes"} <= set(figures)
    assert figures["clips"][0]["name"] == "wave"


def test_a_sample_is_a_video_a_clip_and_its_figures(prior):
    pytest.importorskip("OpenGL")
    result = kinetok("sample", "--prior", prior, "--out", "new.mp4", "--seconds", 0.5, "--count", 2)
    if "EGL" in result.output:
        pytest.skip("no EGL on this machine: nothing can be drawn")
    assert result.exit_code == 0, result.output
    assert Path("new.mp4").stat().st_size > 1000
    assert [len(c.qpos) for c in read_clips(Path("new.safetensors"))] == [15, 15]
    assert json.loads(Path("new.json").read_text())["episodes"] == 2


def test_a_skill_is_measured_and_taken_further(skill, prior, tmp_path):
    words = ("evaluate", "task", "--adapter", skill, "--episodes", 3, "--seconds", 1, "--push", 0.5, "--seed", 2)
    result = kinetok(*words, "--task", "target", "--json", "task.json")
    assert result.exit_code == 0, result.output
    told = json.loads(Path("task.json").read_text())
    assert {"success_rate", "final_distance_m", "return", "survival_rate", "episodes", "seed"} <= told.keys()
    assert (told["episodes"], told["seed"], told["push_mps"], told["task"]) == (3, 2, 0.5, "target")
    assert json.loads(kinetok(*words, "--prior", prior).output) == told
    alone = kinetok("evaluate", "task", "--prior", prior, "--task", "path", "--episodes", 2, "--seconds", 1)
    assert alone.exit_code == 0 and "path_distance_m" in json.loads(alone.output)

    words = ("finetune", "--from", skill, "--set", "task.distance=2,3", "--set", "samples=256", "--preset", "tiny")
    result = kinetok(*words, "--out", "further")
    assert result.exit_code == 0, result.output
    further = load_artifact("further", "adapter", ADAPTER)
    assert further.parents["skill"] == load_artifact(skill, "adapter", ADAPTER).hash
    assert further.config["adapted"]["adapter"]["kind"] == "lora"
    assert further.config["skill"]["task"]["distance"] == [2.0, 3.0]
    assert further.config["skill"]["policy"] == load_artifact(skill, "adapter", ADAPTER).config["skill"]["policy"]


def test_a_skill_is_shown_with_what_is_asked_of_it(skill):
    pytest.importorskip("OpenGL")
    words = ("--seconds", 0.5, "--count", 2, "--top-p", 0.5)
    result = kinetok("sample", "--adapter", skill, "--out", "deep/target.gif", *words)
    if "EGL" in result.output:
        pytest.skip("no EGL on this machine: nothing can be drawn")
    assert result.exit_code == 0, result.output
    assert Path("deep/target.gif").stat().st_size > 1000
    assert [len(c.qpos) for c in read_clips(Path("deep/target.safetensors"))] == [15, 15]
    told = json.loads(Path("deep/target.json").read_text())
    assert told["episodes"] == 2 and told["top_p"] == 0.5 and told["temperature"] == 1.0 and told["task"] == "target"
