"""`kinetok clips`: files are checked, gathered, parted and varied."""

import json

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.formats import read_clips
from kinetok.motion.library import ClipLibrary
from tests.cli.typed import frames, kinetok, write_clip


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


def test_files_of_one_name_are_told_apart(clip, tmp_path):
    more = [write_clip(tmp_path / folder / clip.name, frames(11)) for folder in ("a", "b")]
    out = tmp_path / "all.safetensors"
    told = kinetok("clips", "import", clip, more[0], "--out", out)
    assert told.exit_code == 0 and "another clip is called wave, so this one is wave-2" in told.output
    assert kinetok("clips", "import", more[1], "--append", "--out", out).exit_code == 0
    assert [c.name for c in read_clips(out)] == ["wave", "wave-2", "wave-3"]


def test_a_recording_becomes_a_cycle_and_a_cycle_long_motions(tmp_path):
    body, phase = Character.load("humanoid"), np.arange(120) / 30
    qpos = np.tile(body.stand(), (120, 1))
    qpos[:, 0] = phase
    at = int(body.model.joint("left_hip").qposadr[0])
    qpos[:, at : at + 4] = rotation.from_rotvec(np.outer(0.5 * np.sin(2 * np.pi * phase), [0.0, 1.0, 0.0]))
    source, loop, out = (tmp_path / f"{name}.safetensors" for name in ("recorded", "cycle", "varied"))
    ClipLibrary.write(source, [Clip(name="gait", character="humanoid", fps=30.0, qpos=qpos)])
    once = kinetok("clips", "vary", source, "--out", out, "--seconds", 9)
    assert once.exit_code == 0 and "gait is no loop: gone through once" in once.output and "clips cycle" in once.output
    told = kinetok("clips", "cycle", source, "--out", loop)
    assert told.exit_code == 0 and " s of gait" in told.output
    assert kinetok("clips", "vary", loop, "--out", out, "--seconds", 9).exit_code == 0
    (cycle,), (varied,) = read_clips(loop), read_clips(out)
    assert cycle.loop and cycle.seconds == pytest.approx(1.0, abs=0.04) and varied.seconds == pytest.approx(9, abs=0.1)


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
