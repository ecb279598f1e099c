import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace

import pytest
import torch

from kinetok.checkpoint import CheckpointError, load_artifact, load_state
from kinetok.config import ConfigError, override
from kinetok.logger import read_metrics
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.rl import training
from kinetok.tokenizers import distill, train
from kinetok.tokenizers.fit import fit, train_teachers
from kinetok.tokenizers.tokenizer import MotionTokenizer

BOX = """
<mujoco model="box">
  <worldbody>
    <body name="base">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3"/>
      <body name="arm" pos="0 0 0.5">
        <joint name="elbow" axis="0 1 0" damping="1"/>
        <geom type="sphere" size="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="30"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def clips(wave) -> list[Clip]:
    return [wave("wave", 0.5), wave("sweep", 0.5, reach=-0.8)]


@pytest.fixture(scope="module")
def done(clips, small, tmp_path_factory):
    """A finished fit of all three stages: its folder and the tokenizer."""
    out = tmp_path_factory.mktemp("fit") / "run"
    return out, fit(clips, small, out, seed=0)


def test_another_tokenizer_teaches_and_another_one_is_gone_on_with(done, clips, small, tmp_path):
    out, tokenizer = done
    start = MotionTokenizer.from_pretrained(out / "ppo")
    slow = ["distill.lr=1e-5", "distill.lr_end=1e-5"]
    later = override(small, ["stages=distill", f"teachers={out}", f"start={out / 'ppo'}", *slow])
    taught = fit(clips, later, tmp_path / "one", seed=0)
    parents = load_artifact(tmp_path / "one").parents
    assert parents == {"start": start.hash} | dict.fromkeys(("teacher/wave", "teacher/sweep"), tokenizer.hash)
    apart = override(small, ["stages=distill", f"teachers={out / 'teachers'}"])
    fit(clips, apart, tmp_path / "two", seed=0)
    assert load_artifact(tmp_path / "two").parents == {
        f"teacher/{name}": load_artifact(out / "teachers" / name).hash for name in ("wave", "sweep")
    }
    # It began where the other one was: what it does is nearer to it than what a fresh student does.
    obs = torch.randn(64, sum(start.sizes.values()), generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        wanted, began, fresh = (
            t.act(obs)[0] for t in (start, taught, MotionTokenizer.from_pretrained(tmp_path / "two"))
        )
    assert (began - wanted).norm() < 0.5 * (fresh - wanted).norm()


def test_every_stage_leaves_its_artifact(done):
    out, tokenizer = done
    for path in ("teachers/wave", "teachers/sweep", "distill", "ppo", "."):
        assert load_artifact(out / path, kind="tokenizer").tensors
    best = load_artifact(out)
    assert best.hash == tokenizer.hash
    assert best.hash in {load_artifact(out / stage).hash for stage in ("distill", "ppo")}
    teachers = {f"teacher/{name}": load_artifact(out / "teachers" / name).hash for name in ("wave", "sweep")}
    assert load_artifact(out / "distill").parents == teachers
    assert load_artifact(out / "ppo").parents == {"distill": load_artifact(out / "distill").hash} | teachers
    assert load_artifact(out / "teachers" / "wave").parents == {}


def test_cards_say_what_made_them(done):
    out, _ = done
    stories = {
        "teachers/wave": "Stages: teacher.",
        "distill": "Stages: teacher -> distill.",
        "ppo": "Stages: teacher -> distill -> ppo.",
    }
    for path, story in stories.items():
        card = (out / path / "README.md").read_text()
        assert story in card and "MPJPE" in card and "Seed 0" in card
    assert "2 tokens per control step from a vocabulary of 125" in (out / "README.md").read_text()
    assert "tokens per control step" not in (out / "teachers" / "wave" / "README.md").read_text()


def test_a_finished_fit_returns_at_once(done, clips, small, monkeypatch):
    out, tokenizer = done

    def fail(*args, **kwargs):
        raise AssertionError("a finished run trains or evaluates")

    monkeypatch.setattr(training, "collect", fail)
    monkeypatch.setattr(train, "track", fail)
    monkeypatch.setattr(distill, "track", fail)
    assert fit(clips, small, out, seed=0).hash == tokenizer.hash


def test_it_ends_with_a_table_of_the_clips(done, clips, small, capsys):
    out, _ = done
    fit(clips, small, out, seed=0)
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split() for line in lines if " % " in line]
    assert {row[1] for row in rows} == {"wave", "sweep"}
    score = load_state(out / "teachers" / "wave" / "state.safetensors")[1]["progress"]["score"]
    wave = next(row for row in rows if row[1] == "wave")
    assert wave[-5:] == [f"{100 * score['success'][0]:.0f}", "%", "│", f"{score['mpjpe_mm'][0]:.0f}", "│"]
    assert lines[-1].startswith("best stage: ")


SLEEPER = """
import multiprocessing, sys, time
from pathlib import Path

def work(ready):
    from kinetok.tokenizers.fit import begin_worker
    begin_worker()
    Path(ready).touch()
    time.sleep(100)

if __name__ == "__main__":
    multiprocessing.get_context("spawn").Process(target=work, args=sys.argv[1:2]).start()
"""
TEACHERS = """
import sys
from dataclasses import replace
from pathlib import Path
from kinetok.motion.library import ClipLibrary
from kinetok.presets import FIT
from kinetok.tokenizers.fit import train_teachers

if __name__ == "__main__":
    ready, library, small = Path(sys.argv[1]), ClipLibrary.open(Path(sys.argv[2])), FIT["tiny"]()
    endless = replace(small, workers=2, teacher=replace(small.teacher, samples=10**9))
    train_teachers([library.clip(k) for k in range(2)], endless, ready.parent.parent, seed=0, threads=1)
"""


@pytest.mark.parametrize("script", [SLEEPER, pytest.param(TEACHERS, marks=pytest.mark.slow)], ids=["one", "teachers"])
def test_workers_end_when_their_parent_is_killed(script, clips, tmp_path):
    """Every process holds the pipe, so its end is the end of them all."""
    ready, library, file = tmp_path / "wave" / "metrics.jsonl", tmp_path / "clips.safetensors", tmp_path / "run.py"
    ready.parent.mkdir()
    file.write_text(script)
    ClipLibrary.write(library, clips)
    command = [sys.executable, str(file), str(ready), str(library)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True) as parent:
        try:
            while not ready.exists() and parent.poll() is None:
                time.sleep(0.05)
            assert parent.poll() is None, parent.communicate()[0].decode()
            parent.kill()
            parent.communicate(timeout=10)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(parent.pid, signal.SIGKILL)


def test_a_changed_teacher_is_refused_by_what_came_of_it(clips, small, tmp_path):
    fit(clips[:1], small, tmp_path, seed=0)
    teacher = MotionTokenizer.from_pretrained(tmp_path / "teachers/wave")
    torch.nn.init.zeros_(teacher.decoder[-1].weight)
    teacher.save_pretrained(tmp_path / "teachers/wave", "another")
    before, after = load_artifact(tmp_path).parents["teacher/wave"], load_artifact(tmp_path / "teachers/wave").hash
    with pytest.raises(CheckpointError, match=f"teacher/wave {before[:12]} -> {after[:12]}. Remove .*distill to make"):
        fit(clips[:1], small, tmp_path, seed=0)


def test_teachers_are_the_same_at_any_thread_count(done, clips, small, tmp_path):
    out, _ = done
    before = torch.get_num_threads()
    fit(clips, replace(small, stages=("teacher",)), tmp_path, threads=2)
    assert torch.get_num_threads() == before
    for clip in clips:
        assert load_artifact(tmp_path / "teachers" / clip.name).hash == load_artifact(out / "teachers" / clip.name).hash


@pytest.mark.slow
def test_teachers_side_by_side_are_the_same(done, clips, small, tmp_path):
    out, _ = done
    train_teachers(clips, replace(small, workers=2), tmp_path, seed=0, threads=0)
    for clip in clips:
        assert load_artifact(tmp_path / clip.name).hash == load_artifact(out / "teachers" / clip.name).hash


@pytest.mark.slow
def test_the_first_error_stops_the_teachers_that_wait(wave, small, tmp_path):
    """Eight teachers, two at a time; the first cannot write its folder."""
    names = [f"w{index}" for index in range(8)]
    (tmp_path / "w0").write_text("in the way")
    with pytest.raises(OSError, match="w0"):
        train_teachers([wave(name, 0.5) for name in names], replace(small, workers=2), tmp_path, seed=0, threads=0)
    assert not (tmp_path / "w7").exists()


def test_from_scratch_needs_no_teacher(clips, small, tmp_path):
    fit(clips[:1], replace(small, stages=("ppo",)), tmp_path / "out")
    assert not (tmp_path / "out" / "teachers").exists()
    assert "Stages: ppo." in (tmp_path / "out" / "README.md").read_text()
    assert load_artifact(tmp_path / "out").parents == {}


def test_settings_that_belong_together_come_in_any_order(small):
    for order in (1, -1):
        settings = ["teacher_tokenizer.future=1,9", "tokenizer.future=1,2,9", "ppo.env.scene.substeps=2"]
        config = override(small, ["tokenizer.scene.substeps=2", *settings][::order])
        assert config.teacher_tokenizer.future == (1, 9) and config.ppo.env.scene.substeps == 2
    assert override(small, ["teacher_tokenizer.future=1,9", "stages=ppo"]).stages == ("ppo",)  # nobody labels


def other_body(tmp_path) -> Clip:
    path = tmp_path / "box.xml"
    path.write_text(BOX)
    qpos = Character.load(str(path)).model.qpos0
    return Clip(name="box", character=str(path), fps=30.0, qpos=qpos[None].repeat(5, 0))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            lambda clips, small, tmp_path: ([clips[0], clips[0]], small),
            ConfigError,
            "two clips are named 'wave'; rename a file",
        ),
        (lambda clips, small, tmp_path: ([], small), ValueError, "at least one clip"),
        (
            lambda clips, small, tmp_path: (
                clips,
                override(small, ["stages=distill", "teachers=humanoid-teacher", "tokenizer.scene.control_hz=60"]),
            ),
            ConfigError,
            "humanoid-teacher moves another body or in other physics than tokenizer says: scene.control_hz: 30 -> 60",
        ),
        (
            lambda clips, small, tmp_path: ([other_body(tmp_path)], small),
            ConfigError,
            "tokenizer.character is 'humanoid'; set tokenizer.character=",
        ),
        (
            lambda clips, small, tmp_path: (clips, replace(small, stages=("teacher", "distil"))),
            ConfigError,
            "unknown stage 'distil'; did you mean 'distill'?; stages: teacher, distill, ppo",
        ),
        (lambda clips, small, tmp_path: (clips, override(small, ["stages=()"])), ConfigError, "stages is empty"),
        (
            lambda clips, small, tmp_path: (clips, override(small, ["workers=0"])),
            ConfigError,
            "config: workers must be at least 1, not 0; 1 trains one teacher after the other",
        ),
        (
            lambda clips, small, tmp_path: (clips, override(small, ["teacher.rows=0"])),
            ConfigError,
            "config.teacher: rows must be at least 1, not 0",
        ),
        (
            lambda clips, small, tmp_path: (clips, override(small, ["start=humanoid-fsq"])),
            ConfigError,
            "start humanoid-fsq is of another shape: ",
        ),
        (
            lambda clips, small, tmp_path: (clips, override(small, ["tokenizer.scalars=4"])),
            ValueError,
            "cannot group 6 scalars by 4: scalars per token must be a divisor of 6",
        ),
        (
            lambda clips, small, tmp_path: (clips, override(small, ["ppo.env.scene.substeps=2"])),
            ConfigError,
            "a stage's env.scene differs from tokenizer.scene (substeps: 4 -> 2); set the latter",
        ),
    ],
)
def test_refused_before_anything_is_written(change, error, message, clips, small, tmp_path):
    with pytest.raises(error, match=re.escape(message)):
        fit(*change(clips, small, tmp_path), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_with_a_foreign_readme_is_left_alone(clips, small, tmp_path):
    (tmp_path / "README.md").write_text("mine")
    with pytest.raises(CheckpointError, match=r"holds a README\.md that kinetok did not write"):
        fit(clips, small, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]
    assert (tmp_path / "README.md").read_text() == "mine"


def test_finished_teachers_are_not_passed_off_as_others(done, clips, small):
    out, _ = done
    changed = replace(small, teacher=replace(small.teacher, rows=64))
    with pytest.raises(CheckpointError, match=r"stage\.rows: 32 -> 64"):
        fit(clips, changed, out)


def test_other_motions_of_the_same_names_are_refused_before_a_teacher_of_them(done, wave, clips, small):
    out, _ = done
    with pytest.raises(CheckpointError, match=r"this run is of other clips: .*frames: "):
        fit([replace(clip, qpos=clip.qpos[:-1]) for clip in clips], small, out)
    with pytest.raises(CheckpointError, match=r"this run is of other clips: clips: "):
        fit([wave("third")], small, out)
    assert not (out / "teachers" / "third").exists()


def test_more_samples_take_a_finished_teacher_further(clips, small, tmp_path):
    train_teachers(clips[:1], small, tmp_path, seed=0, threads=1)
    further = replace(small, teacher=replace(small.teacher, samples=1536))
    train_teachers(clips[:1], further, tmp_path, seed=0, threads=1)
    assert [x["step"] for x in read_metrics(tmp_path / clips[0].name / "metrics.jsonl")][-1] == 1536
