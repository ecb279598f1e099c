"""--device: one that is not there, and where there is a GPU the whole chain on it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

from kinetok.cli import main
from kinetok.demo import CLIPS
from kinetok.motion.library import ClipLibrary

DEVICE = "cuda"


@pytest.fixture(autouse=True)
def apart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_device_that_is_not_there_is_refused_before_any_work():
    for name in ("cudo", f"cuda:{torch.cuda.device_count()}"):
        told = ["tokenize", "fit", "--clips", "none.txt", "--preset", "tiny", "--out", "fit", "--device", name]
        result = CliRunner().invoke(main, told, catch_exceptions=False)
        assert result.exit_code == 2 and not Path("fit").exists()
        assert f"torch cannot use '{name}'" in result.output and "here there is cpu" in result.output
    assert torch.get_default_device() == torch.device("cpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_the_chain_on_a_gpu():
    ClipLibrary.write(Path("walk.safetensors"), [ClipLibrary.open(CLIPS).clip(0)])

    def run(*args: object) -> None:
        command = [sys.executable, "-m", "kinetok.cli", *map(str, args), "--device", DEVICE, "--threads", "2"]
        subprocess.run(command, check=True, capture_output=True)

    clips = ("--clips", "walk.safetensors")
    for samples in (1024, 2048):  # the second goes on where the first one ended
        run("tokenize", "fit", *clips, "--preset", "tiny", "--out", "fit", "--set", f"ppo.samples={samples}")
    run("pretrain", "--tokenizer", "fit", *clips, "--preset", "tiny", "--out", "prior")
    few = [f"hindsight.{name}" for name in ("samples=640", "rows=32", "iterations=10", "rounds=2", "memory=1")]
    for samples in (512, 1024):
        told = [x for setting in (*few, f"samples={samples}") for x in ("--set", setting)]
        method = ("--task", "target", "--method", "sft,hindsight,rl", "--preset", "tiny")
        run("finetune", "--prior", "prior", *method, *clips, "--out", "skill", *told)
    run("evaluate", "task", "--adapter", "skill", "--episodes", 4, "--json", "task.json")
    run("evaluate", "tracking", "--tokenizer", "fit", *clips, "--json", "tracking.json")
    assert 0 <= json.loads(Path("task.json").read_text())["survival_rate"] <= 1
    assert json.loads(Path("tracking.json").read_text())["clips"][0]["mpjpe_mm"] > 0
