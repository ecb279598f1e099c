"""The files that one command writes and the next reads: a clip, a run, tokens, a prior, a skill."""

from pathlib import Path

import pytest

from tests.cli.typed import frames, kinetok, write_clip


@pytest.fixture(autouse=True)
def apart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def clip(tmp_path_factory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips") / "humanoid3d_wave.txt", frames())


@pytest.fixture(scope="session")
def run(clip, tmp_path_factory) -> Path:
    """A finished `tokenize fit`."""
    out = tmp_path_factory.mktemp("run") / "wave"
    result = kinetok("tokenize", "fit", "--clips", clip, "--out", out, "--preset", "tiny", "--set", "ppo.samples=512")
    assert result.exit_code == 0 and "best stage" in result.output
    return out


@pytest.fixture(scope="session")
def tokens(run, clip, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("tokens") / "wave.safetensors"
    result = kinetok("tokenize", "encode", clip, "--tokenizer", run, "--out", out)
    assert result.exit_code == 0 and f"wrote {out}: 15 control steps of 2 tokens" in result.output
    return out


@pytest.fixture(scope="session")
def prior(run, clip, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("prior") / "wave"
    assert kinetok("pretrain", "--tokenizer", run, "--clips", clip, "--out", out, "--preset", "tiny").exit_code == 0
    return out


@pytest.fixture(scope="session")
def skill(prior, clip, tmp_path_factory) -> Path:
    """Examples first, then the task."""
    out = tmp_path_factory.mktemp("skill") / "target"
    words = ("--task", "target", "--adapter", "lora", "--method", "sft,rl", "--clips", clip, "--set", "samples=256")
    result = kinetok("finetune", "--prior", prior, *words, "--out", out, "--preset", "tiny", "--threads", 1)
    assert result.exit_code == 0, result.output
    # 2 tokens of 125, width 16, one block: A and B of rank 2 on 64, 32, 80 and 80 sides, the token's net of 8.
    first = result.output.splitlines()[0]
    assert first.startswith(f"lora adapter of {2 * 256 + 5 * 8 + 9 * 16:,} parameters, ") and "stay frozen" in first
    assert "best evaluation: " in result.output and str(out) in result.output
    return out
