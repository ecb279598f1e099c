"""What a person gets wrong is one line that says what to do, and nothing is written."""

from pathlib import Path

import numpy as np
import pytest
import torch

from kinetok.checkpoint import load_artifact, save_artifact
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from tests.cli.typed import FIT, frames, kinetok, write_clip


def gpt(path: Path) -> Path:
    return save_artifact(path / "prior", kind="gpt", config={}, tensors={"x": torch.zeros(1)}, card="")


def bad(tmp_path: Path, change) -> Path:
    rows = frames()
    change(rows)
    return write_clip(tmp_path / "bad.txt", rows)


def text(tmp_path: Path, content: str) -> Path:
    path = tmp_path / "broken.txt"
    path.write_text(content)
    return path


def same(run: Path, stage: str) -> bool:
    return load_artifact(run).hash == load_artifact(run / stage).hash


WRONG = {
    "missing clip": (lambda p, c, r, t: (*FIT, p / "no.txt"), "no.txt: file: does not exist"),
    "malformed clip": (lambda p, c, r, t: (*FIT, text(p, '{"Frames": [[0.1,')), "broken.txt: line 1: not JSON"),
    "unknown format": (lambda p, c, r, t: (*FIT, text(p, "hello")), "broken.txt: first bytes: unknown format"),
    "columns": (
        lambda p, c, r, t: (*FIT, bad(p, lambda rows: rows[3].pop())),
        "bad.txt: frame 3: 43 columns; the format has 44",
    ),
    "nan": (
        lambda p, c, r, t: (*FIT, bad(p, lambda rows: rows[2].__setitem__(9, float("nan")))),
        "bad.txt: frame 2, column 9: nan is not a finite number",
    ),
    "zero length": (
        lambda p, c, r, t: (*FIT, bad(p, lambda rows: [row.__setitem__(0, 0.0) for row in rows])),
        "bad.txt: Frames: fewer than two frames of positive duration",
    ),
    "one frame": (lambda p, c, r, t: (*FIT, bad(p, lambda rows: rows.__delitem__(slice(1, None)))), "at least two fr"),
    "empty folder": (lambda p, c, r, t: (*FIT, p), "folder: holds no motion file"),
    "same clip twice": (lambda p, c, r, t: (*FIT, c, "--clips", c), "two clips are named 'wave'; rename a file"),
    "preset": (
        lambda p, c, r, t: (*FIT, c, "--preset", "one-clp"),
        "unknown preset 'one-clp'; one of: one-clip, many-clips, generalist, robust, experts, from-scratch, tiny; "
        "did you mean 'one-clip'?",
    ),
    "setting": (
        lambda p, c, r, t: (*FIT, c, "--set", "teacher.sample=5"),
        "config.teacher: unknown key 'sample'; one of: samples",
    ),
    "stage": (
        lambda p, c, r, t: (*FIT, c, "--stages", "teacher,distil"),
        "unknown stage 'distil'; did you mean 'distill'?",
    ),
    "tokens that do not divide": (
        lambda p, c, r, t: (*FIT, c, "--set", "tokenizer.scalars=4"),
        "cannot group 6 scalars by 4",
    ),
    "encode by another kind": (
        lambda p, c, r, t: ("tokenize", "encode", c, "--tokenizer", gpt(p)),
        "is a 'gpt'; a 'tokenizer' was asked for",
    ),
    "encode by a teacher": (
        lambda p, c, r, t: ("tokenize", "encode", c, "--tokenizer", r / "teachers" / "wave"),
        "a continuous tokenizer has no tokens",
    ),
    "unknown packaged name": (
        lambda p, c, r, t: ("tokenize", "encode", c, "--tokenizer", "humanoid-fsk"),
        "there is no directory humanoid-fsk",
    ),
    "encode less than a control step": (
        lambda p, c, r, t: ("tokenize", "encode", c, "--tokenizer", r, "--seconds", 0.01),
        "0.01 seconds of clip 'wave' hold no control step",
    ),
    "decode a clip": (
        lambda p, c, r, t: ("tokenize", "decode", c, "--tokenizer", r),
        "humanoid3d_wave.txt is not a safetensors file",
    ),
    "pretrain on clips of another body": (
        lambda p, c, r, t: ("pretrain", "--tokenizer", r, "--clips", robot(p), "--preset", "tiny"),
        "clip 'robot' is of 'g1', the tokenizer of 'humanoid'; retarget it first: kinetok clips import --character",
    ),
    "a packaged skill as tokenizer": (
        lambda p, c, r, t: ("tokenize", "encode", c, "--tokenizer", "humanoid-target"),
        "the packaged humanoid-target is a 'adapter'; of the kind asked for: humanoid-fsq",
    ),
    "split what is no library": (lambda p, c, r, t: ("clips", "split", c), "is no clip library; make one: kinetok"),
    "no iterations": (
        lambda p, c, r, t: ("pretrain", "--tokenizer", r, "--clips", c, "--preset", "tiny", "--set", "batch=0"),
        "batch must be at least 1, not 0",
    ),
    "a layer of no width": (
        lambda p, c, r, t: (*FIT, c, "--set", "tokenizer.encoder=[-1]"),
        "encoder holds widths of layers, of at least 1 each, not (-1,)",
    ),
    "decode by another tokenizer": (
        lambda p, c, r, t: ("tokenize", "decode", t, "--tokenizer", r / ("ppo" if same(r, "distill") else "distill")),
        "use the tokenizer that wrote them",
    ),
    "import nothing": (lambda p, c, r, t: ("clips", "import", p / "no.txt"), "no.txt: file: does not exist"),
}


def robot(folder: Path) -> Path:
    """A library of one standing G1."""
    stand = np.tile(Character.load("g1").stand(), (30, 1))
    ClipLibrary.write(folder / "g1.safetensors", [Clip(name="robot", character="g1", fps=30.0, qpos=stand)])
    return folder / "g1.safetensors"


@pytest.mark.parametrize(("args", "message"), WRONG.values(), ids=WRONG)
def test_a_mistake_is_one_line_and_writes_nothing(args, message, tmp_path, clip, run, tokens):
    words, out = args(tmp_path, clip, run, tokens), tmp_path / "new" / "out.safetensors"
    result = kinetok(*words, "--out", out)
    assert result.exit_code == 1
    assert result.output.startswith("Error: ") and result.output.count("\n") == 1
    assert message in result.output and "Traceback" not in result.output
    assert not out.parent.exists()


TUNE = ("finetune", "--preset", "tiny", "--prior")


UNFIT = {  # from the prior, the clip, and a skill
    "task": (
        lambda g, c, s: (*TUNE, g, "--task", "targt"),
        "unknown task 'targt'; one of: target, steering, path; did",
    ),
    "adapter": (lambda g, c, s: (*TUNE, g, "--adapter", "colla"), "did you mean 'cola'?"),
    "method": (lambda g, c, s: (*TUNE, g, "--method", "rll"), "unknown method 'rll'; did you mean 'rl'?"),
    "target module": (
        lambda g, c, s: (*TUNE, g, "--set", "adapter.targets=qkw"),
        "no linear layer is called 'qkw'; one of ",
    ),
    "setting": (
        lambda g, c, s: (*TUNE, g, "--adapter", "lora", "--set", "adapter.rnk=3"),
        "config.adapter: unknown key 'rnk'; one of: kind, rank, alpha, dropout, targets, hidden; did you mean 'rank'?",
    ),
    "setting of another adapter": (
        lambda g, c, s: (*TUNE, g, "--adapter", "lora", "--set", "adapter.task_token=false"),
        "config.adapter: unknown key 'task_token'",
    ),
    "task setting": (lambda g, c, s: (*TUNE, g, "--set", "task.nera=1"), "did you mean 'near'?"),
    "rank": (lambda g, c, s: (*TUNE, g, "--set", "adapter.rank=0"), "CoLA needs rank >= 1, not 0"),
    "nucleus": (lambda g, c, s: (*TUNE, g, "--set", "policy.top_p=2"), "top_p must lie in (0, 1], not 2.0"),
    "preset": (lambda g, c, s: ("finetune", "--preset", "latop", "--prior", g), "did you mean 'laptop'?"),
    "no clips": (lambda g, c, s: (*TUNE, g, "--method", "sft"), "needs example clips: --clips PATH"),
    "clips for rl": (lambda g, c, s: (*TUNE, g, "--clips", c), "add --method sft"),
    "no prior": (lambda g, c, s: (*TUNE, "humanoid-gtp"), "did you mean 'humanoid-gpt'?"),
    "skill as prior": (lambda g, c, s: (*TUNE, s), "has no config.json"),
    "another shape than from": (
        lambda g, c, s: (*TUNE, g, "--from", s, "--adapter", "cola"),
        "holds an adapter of another shape: adapter.kind: lora -> cola",
    ),
    "another prior than from": (
        lambda g, c, s: (*TUNE, "humanoid-gpt", "--from", s),
        "but humanoid-gpt is ",
    ),
}


@pytest.mark.parametrize(("args", "message"), UNFIT.values(), ids=UNFIT)
def test_what_does_not_fit_is_one_line_and_writes_nothing(args, message, tmp_path, prior, clip, skill):
    result = kinetok(*args(prior, clip, skill), "--out", tmp_path / "new" / "out")
    assert result.exit_code == 1
    assert result.output.startswith("Error: ") and result.output.count("\n") == 1
    assert message in result.output
    assert not (tmp_path / "new").exists()


def test_a_skill_cannot_do_another_task(skill, prior):
    result = kinetok("evaluate", "task", "--adapter", skill, "--task", "steering")
    assert result.exit_code == 1 and "was bent to 'target' and cannot read what 'steering' asks" in result.output
    result = kinetok("evaluate", "task", "--prior", prior, "--task", "stering")
    assert result.exit_code == 1 and "did you mean 'steering'?" in result.output
    result = kinetok("sample", "--adapter", prior, "--out", "x.mp4")
    assert result.exit_code == 1 and "has no adapter_config.json" in result.output


@pytest.mark.parametrize(
    ("words", "allowed"),
    [
        (("clips", "import", "CLIP"), ".safetensors"),
        (("tokenize", "encode", "CLIP", "--tokenizer", "RUN"), ".safetensors"),
        (
            ("tokenize", "decode", "TOKENS", "--tokenizer", "RUN"),
            ".safetensors or .mp4 or .gif or .bvh or .csv or .npz",
        ),
        (("sample",), ".mp4 or .gif"),
    ],
)
def test_the_suffix_is_judged_before_any_work(words, allowed, tmp_path):
    result = kinetok(*words, "--out", tmp_path / "out.txt")
    assert result.exit_code == 1
    assert result.output == f"Error: --out {tmp_path / 'out.txt'}: the name must end in {allowed}\n"


def test_numbers_out_of_range_are_refused_by_their_option(clip, run):
    for words, option in (
        (("evaluate", "tracking", "--tokenizer", run, "--clips", clip, "--episodes", 0), "--episodes"),
        (("evaluate", "prior", "--seconds", 0), "--seconds"),
        (("evaluate", "task", "--push", "nan"), "--push"),
        (("sample", "--out", "x.mp4", "--seconds", 1e9), "--seconds"),
        (("sample", "--out", "x.mp4", "--temperature", -1), "--temperature"),
        (("clips", "vary", clip, "--out", "x.safetensors", "--count", 0), "--count"),
    ):
        result = kinetok(*words)
        assert result.exit_code == 2 and f"Invalid value for '{option}'" in result.output, words


def test_where_a_result_cannot_be_written_is_said_before_it_is_made(clip, run, tmp_path):
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path, tmp_path / "file" / "out.json"):
        result = kinetok("evaluate", "tracking", "--tokenizer", run, "--clips", clip, "--json", place)
        assert result.exit_code == 2 and "Invalid value for '--json'" in result.output
    assert (tmp_path / "file").read_text() == "mine"


def test_nothing_is_written_over_what_is_something_else(clip, run, prior, tokens, tmp_path):
    before = load_artifact(run).hash
    result = kinetok("pretrain", "--tokenizer", run, "--clips", clip, "--preset", "tiny", "--out", run)
    assert result.exit_code == 1 and "holds a 'tokenizer', which a 'prior' would replace" in result.output
    result = kinetok("finetune", "--preset", "tiny", "--prior", prior, "--out", run)
    assert result.exit_code == 1 and "holds a 'tokenizer', which a 'adapter' would replace" in result.output
    assert load_artifact(run).hash == before
    kept = tokens.read_bytes()
    result = kinetok("tokenize", "decode", tokens, "--tokenizer", run, "--out", tokens)
    assert result.exit_code == 1 and "holds the tokens themselves" in result.output
    result = kinetok("sample", "--prior", prior, "--out", tokens.with_suffix(".mp4"), "--seconds", 1)
    assert result.exit_code == 1 and f"{tokens} is another file; choose another name" in result.output
    assert tokens.read_bytes() == kept


def test_a_stopped_training_says_how_it_goes_on(clip, tmp_path, monkeypatch):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("kinetok.tokenizers.fit.fit", stop)
    result = kinetok(*FIT, clip, "--out", tmp_path / "run")
    assert result.exit_code == 1 and "stopped before its first state was written" in result.output
    (tmp_path / "run" / "ppo").mkdir(parents=True)
    (tmp_path / "run" / "ppo" / "state.safetensors").write_bytes(b"")
    result = kinetok(*FIT, clip, "--out", tmp_path / "run")
    assert result.exit_code == 1 and f"goes on from the last state in {tmp_path / 'run'}" in result.output


def test_a_file_where_a_folder_should_be_is_one_line(clip, tmp_path):
    (tmp_path / "taken").write_text("mine")
    result = kinetok(*FIT, clip, "--out", tmp_path / "taken" / "run")
    assert result.exit_code == 1 and result.output.startswith("Error: ") and "taken" in result.output
    assert (tmp_path / "taken").read_text() == "mine"
