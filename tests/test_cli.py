"""The commands as a person types them, each eating the files of the one before."""

import json
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
import torch
from click.testing import CliRunner, Result

from kinetok.checkpoint import ADAPTER, load_artifact, save_artifact
from kinetok.cli import main
from kinetok.motion.formats import read_clips
from kinetok.tokenizers.codec import TokenStream


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def apart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def frames(count: int = 16) -> list[list[float]]:
    """DeepMimic rows: duration, position (y up), root, chest, neck, right leg and arm, left leg and arm.

    The figure stands and its left shoulder swings by half a radian.
    """
    identity = [1.0, 0.0, 0.0, 0.0]
    rows = []
    for t in np.linspace(0, 1, count):
        half = 0.25 * np.sin(2 * np.pi * t)
        limbs = [*identity, 0.0, *identity, *identity, 0.2, *identity, 0.0, *identity]
        arm = [float(np.cos(half)), float(np.sin(half)), 0.0, 0.0, 0.2]
        rows.append([1 / 30, 0.0, 0.9, 0.0, *identity, *identity, *identity, *limbs, *arm])
    return rows


def write_clip(path: Path, rows: list[list[float]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"Loop": "none", "Frames": rows}))
    return path


def kinetok(*args: object) -> Result:
    return CliRunner().invoke(main, [str(arg) for arg in args], catch_exceptions=False)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips") / "humanoid3d_wave.txt", frames())


@pytest.fixture(scope="module")
def run(clip, tmp_path_factory) -> Path:
    """A finished `tokenize fit`."""
    out = tmp_path_factory.mktemp("run") / "wave"
    result = kinetok("tokenize", "fit", "--clips", clip, "--out", out, "--preset", "tiny", "--set", "ppo.samples=512")
    assert result.exit_code == 0 and "best stage" in result.output
    return out


@pytest.fixture(scope="module")
def tokens(run, clip, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("tokens") / "wave.safetensors"
    result = kinetok("tokenize", "encode", clip, "--tokenizer", run, "--out", out)
    assert result.exit_code == 0 and f"wrote {out}: tokens (15, 2)" in result.output
    return out


def leaves(group: click.Group, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    found = []
    for name, command in group.commands.items():
        found += leaves(command, (*path, name)) if isinstance(command, click.Group) else [(*path, name)]
    return found


def command_at(path: tuple[str, ...]) -> click.Command:
    command = main
    for name in path:
        command = command.commands[name]  # type: ignore[attr-defined]
    return command


def test_the_commands_stand_in_the_order_of_the_chain():
    result = kinetok("--help")
    assert result.exit_code == 0
    order = [result.output.index(f"\n  {name} ") for name in ("clips", "tokenize", "pretrain", "sample", "evaluate")]
    assert order == sorted(order)
    assert "kinetok tokenize fit --clips walk.txt --out runs/w" in result.output
    assert kinetok("--version").output.startswith("kinetok, version ")


@pytest.mark.parametrize("path", leaves(main), ids=" ".join)
def test_every_command_and_option_explains_itself(path):
    result = kinetok(*path, "--help")
    assert result.exit_code == 0 and "Usage: " in result.output
    command = command_at(path)
    assert command.help and len(command.help.split()) >= 6
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{' '.join(path)} {parameter.opts[0]} has no help"
            assert parameter.opts[0] in result.output
            shown = parameter.show_default or parameter.required or parameter.multiple or not parameter.default
            assert shown, f"{' '.join(path)} {parameter.opts[0]} does not show its default {parameter.default}"


@pytest.mark.parametrize("args", [["--help"], ["tokenize", "--help"], ["tokenize", "fit", "--help"]], ids=" ".join)
def test_help_loads_no_torch(args):
    code = (
        "import sys\nfrom kinetok.cli import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "assert not {'torch', 'mujoco', 'numpy'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, *args], check=True, capture_output=True, cwd=Path(__file__).parents[1])


def test_clips_check_tells_repairs_and_refuses(data_dir, tmp_path):
    good, bad = (data_dir / "bvh" / "cmu_daz" / f"cmu_{name}.bvh" for name in ("02_01", "05_03"))
    told = kinetok("clips", "check", good)
    assert told.exit_code == 0 and "6 frames dropped" in told.output
    mixed = kinetok("clips", "check", good, bad, "--fix", "--out", tmp_path / "fixed.safetensors")
    assert mixed.exit_code == 1 and "left out: cmu_05_03" in mixed.output
    assert [clip.name for clip in read_clips(tmp_path / "fixed.safetensors")] == ["cmu_02_01"]
    lone = kinetok("clips", "check", good, "--fix")
    assert lone.exit_code == 1 and "give both --fix and --out" in lone.output


def test_clips_check_goes_on_past_what_it_cannot_read(data_dir, tmp_path):
    walk = (data_dir / "bvh" / "cmu_daz" / "cmu_02_01.bvh").read_text()
    for folder, text in (("a", walk), ("b", "HIERARCHY\nROOT"), ("c", walk)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "walk.bvh").write_text(text)
    out = tmp_path / "good.safetensors"
    told = kinetok("clips", "check", tmp_path, tmp_path / "none.bvh", "--fix", "--out", out)
    assert told.exit_code == 1
    assert "walk.bvh\n  refused unreadable" in told.output and "none.bvh: file: does not exist" in told.output
    copy, whole = tmp_path / "a" / "walk.bvh", tmp_path / "c" / "walk.bvh"
    assert f"{copy} walk is in {whole} walk from 0.00 s on" in told.output
    assert f"left out: {copy} walk (a copy), none.bvh, walk.bvh" in told.output
    assert [motion.name for motion in read_clips(out)] == ["walk"]
    assert kinetok("clips", "check", tmp_path / "a", tmp_path / "c").exit_code == 0  # a copy alone is no fault


def test_a_library_grows_and_is_parted(clip, tmp_path):
    others = [write_clip(tmp_path / "more" / f"c{number}.txt", frames(11)) for number in range(9)]
    out = tmp_path / "all.safetensors"
    assert kinetok("clips", "import", clip, "--half", "--out", out).exit_code == 0
    assert kinetok("clips", "import", *others, "--append", "--out", out).output.startswith(f"added to {out}: 9 clips")
    assert len(read_clips(out)) == 10
    assert kinetok("clips", "split", out, "--share", 0.3, "--mirror", "--out", tmp_path / "parts").exit_code == 0
    train, held = (read_clips(tmp_path / "parts" / f"{name}.safetensors") for name in ("train", "held_out"))
    assert len(train) + len(held) == 20 and held and not {c.source for c in train} & {c.source for c in held}
    wrong = kinetok("clips", "split", out, "--share", 1.5, "--out", tmp_path / "none")
    assert wrong.exit_code == 1 and "between 0 and 1" in wrong.output and not (tmp_path / "none").exists()


def test_what_is_refused_can_be_left_out(clip, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "broken.bvh").write_text("HIERARCHY\nROOT hip\n")
    write_clip(tmp_path / "folder" / "good.txt", frames(11))
    out = tmp_path / "all.safetensors"
    stops = kinetok("clips", "import", tmp_path / "folder", "--out", out)
    assert stops.exit_code == 1 and "broken.bvh: line" in stops.output and not out.exists()
    goes_on = kinetok("clips", "import", tmp_path / "folder", "--skip", "--out", out)
    assert goes_on.exit_code == 0 and "left out " in goes_on.output and "broken.bvh: line" in goes_on.output
    assert "1 clips, 0.3 s; 1 files were refused" in goes_on.output and [c.name for c in read_clips(out)] == ["good"]
    nothing = kinetok(
        "clips", "import", tmp_path / "folder" / "broken.bvh", "--skip", "--out", tmp_path / "n.safetensors"
    )
    assert nothing.exit_code == 1 and not (tmp_path / "n.safetensors").exists()


def test_joints_unit_and_axis_can_be_named(data_dir, tmp_path):
    walk = data_dir / "bvh" / "cmu_motionbuilder" / "cmu_12_01_walk.bvh"
    text = walk.read_text().replace("LeftUpLeg", "XY").replace("LHipJoint", "Q")
    source, out = tmp_path / "odd.bvh", tmp_path / "odd.safetensors"
    source.write_text(text)
    unknown = kinetok("clips", "import", source, "--out", out)
    assert unknown.exit_code == 1 and "Name them: --part left_thigh=JOINT" in unknown.output
    words = ("clips", "import", source, "--out", out, "--part", "left_thigh=XY", "--unit", "cmu", "--up", "y")
    named = kinetok(*words)
    assert named.exit_code == 0 and "(given)" in named.output, named.output
    assert "give a part and a joint" in kinetok(*words, "--part", "left_thigh").output
    small = kinetok("clips", "import", walk, "--out", out, "--unit", "mm")
    assert small.exit_code == 1 and "the body is 0.0241 m large" in small.output and "--unit" in small.output


def test_hours_of_a_library_are_drawn(clip, tmp_path):
    out, json_of = tmp_path / "all.safetensors", tmp_path / "few.json"
    others = [write_clip(tmp_path / "more" / f"c{number}.txt", frames(11)) for number in range(9)]
    assert kinetok("clips", "import", clip, *others, "--out", out).exit_code == 0
    words = ("evaluate", "tracking", "--clips", out, "--episodes", 1, "--json", json_of)
    assert kinetok(*words, "--hours", 1 / 3600, "--seed", 3).exit_code == 0
    few = json.loads(json_of.read_text())["clips"]
    assert 1 < len(few) < 10
    one = kinetok(
        "tokenize", "encode", out, "--tokenizer", "humanoid-fsq", "--name", "c4", "--out", tmp_path / "t.safetensors"
    )
    assert one.exit_code == 0, one.output
    several = kinetok("tokenize", "encode", out, "--tokenizer", "humanoid-fsq", "--out", tmp_path / "u.safetensors")
    assert several.exit_code == 1 and "holds 10 clips; choose one with --name" in several.output


def test_a_library_is_of_one_body(clip, data_dir, tmp_path):
    robot, out = data_dir / "g1" / "kimodo_wxyz" / "kimodo_walk.csv", tmp_path / "both.safetensors"
    result = kinetok("clips", "import", clip, robot, "--out", out)
    assert result.exit_code == 1 and not out.exists()
    assert "wave is of 'humanoid'; kimodo_walk is of 'g1': a library holds motion of one body" in result.output
    asked = kinetok("clips", "import", robot, "--dialect", "kimodo", "--fps", 60, "--out", out)
    assert asked.exit_code == 0 and "kimodo as asked, 60 fps as asked" in read_clips(out)[0].source
    assert "0.0 is not in the range" in kinetok("clips", "import", robot, "--fps", 0, "--out", out).output


def test_clips_info_says_what_a_file_holds(clip):
    result = kinetok("clips", "info", clip)
    header, row = result.output.splitlines()
    assert header.split()[:5] == ["name", "frames", "fps", "seconds", "loop"]
    assert row.split()[:5] == ["wave", "16", "30.00", "0.50", "no"]
    assert abs(float(row.split()[5])) < 0.01 and row.endswith("humanoid3d_wave.txt")


def test_clips_import_gathers_files_into_a_library(clip, tmp_path):
    other = write_clip(tmp_path / "in" / "other.txt", frames(11))
    out = tmp_path / "new" / "both.safetensors"
    result = kinetok("clips", "import", clip, tmp_path / "in", "--out", out)
    assert result.output == f"wrote {out}: 2 clips, 0.8 s\n"
    assert [c.name for c in read_clips(out)] == ["wave", "other"]
    assert kinetok("clips", "info", out).output.splitlines()[1:] == [
        line for path in (clip, other) for line in kinetok("clips", "info", path).output.splitlines()[1:]
    ]


def test_clips_vary_makes_as_many_motions_as_asked_for(data_dir, tmp_path):
    walk, jog = (data_dir / "train" / "deepmimic" / f"humanoid3d_{gait}.txt" for gait in ("walk", "jog"))
    out = tmp_path / "varied.safetensors"
    assert kinetok("clips", "vary", walk, "--seconds", 3, "--count", 2, "--out", out).exit_code == 0
    one, two = read_clips(out)
    assert (one.name, two.name) == ("walk-varied-1", "walk-varied-2") and not np.array_equal(one.qpos, two.qpos)
    assert kinetok("clips", "vary", walk, "--into", jog, "--seconds", 3, "--out", out).exit_code == 0
    assert [clip.name for clip in read_clips(out)] == ["walk-jog-varied"]
    assert kinetok("clips", "vary", walk, "--style", 1, "--seconds", 3, "--count", 2, "--out", out).exit_code == 0
    first, second = read_clips(out)
    assert abs(first.qpos[0, 7:] - second.qpos[0, 7:]).max() > 0.05


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


@pytest.fixture(scope="module")
def prior(run, clip, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("prior") / "wave"
    assert kinetok("pretrain", "--tokenizer", run, "--clips", clip, "--out", out, "--preset", "tiny").exit_code == 0
    return out


@pytest.fixture(scope="module")
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


FIT = ("tokenize", "fit", "--preset", "tiny", "--clips")
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
    "encode no time": (
        lambda p, c, r, t: ("tokenize", "encode", c, "--tokenizer", r, "--seconds", 0),
        "0 seconds of clip 'wave' hold no control step",
    ),
    "decode a clip": (
        lambda p, c, r, t: ("tokenize", "decode", c, "--tokenizer", r),
        "humanoid3d_wave.txt is not a safetensors file",
    ),
    "decode by another tokenizer": (
        lambda p, c, r, t: ("tokenize", "decode", t, "--tokenizer", r / ("ppo" if same(r, "distill") else "distill")),
        "use the tokenizer that wrote them",
    ),
    "import nothing": (lambda p, c, r, t: ("clips", "import", p / "no.txt"), "no.txt: file: does not exist"),
}


def same(run: Path, stage: str) -> bool:
    return load_artifact(run).hash == load_artifact(run / stage).hash


@pytest.mark.parametrize(("args", "message"), WRONG.values(), ids=WRONG)
def test_a_mistake_is_one_line_and_writes_nothing(args, message, tmp_path, clip, run, tokens):
    words, out = args(tmp_path, clip, run, tokens), tmp_path / "new" / "out.safetensors"
    result = kinetok(*words, "--out", out)
    assert result.exit_code == 1
    assert result.output.startswith("Error: ") and result.output.count("\n") == 1
    assert message in result.output and "Traceback" not in result.output
    assert not out.parent.exists()


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


def test_a_file_where_a_folder_should_be_is_one_line(clip, tmp_path):
    (tmp_path / "taken").write_text("mine")
    result = kinetok(*FIT, clip, "--out", tmp_path / "taken" / "run")
    assert result.exit_code == 1 and result.output.startswith("Error: ") and "taken" in result.output
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_traceback_can_be_had(tmp_path, monkeypatch):
    monkeypatch.setenv("KINETOK_TRACEBACK", "1")
    with pytest.raises(ValueError, match="does not exist"):
        kinetok("clips", "info", tmp_path / "no.txt")
