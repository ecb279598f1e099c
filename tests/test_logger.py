"""logger.py: what a run and a resumed run leave in metrics.jsonl, what a pipe shows, messages."""

import json

import pytest
import torch

from kinetok.logger import Logger, read_metrics


def run(out, steps, start=0, total=10, **options):
    with Logger(out, total=total, title="toy", start=start, **options) as log:
        for step in steps:
            log.write(step, {"loss": 1.0 / (step + 1)})


def test_lines_are_on_disk_as_soon_as_they_are_written(tmp_path):
    with Logger(tmp_path / "run", total=2, title="toy", quiet=True) as log:
        log.write(0, {"loss": torch.tensor(0.5), "nan": float("nan")})  # type: ignore[dict-item]
        (line,) = read_metrics(tmp_path / "run" / "metrics.jsonl")
    assert list(line) == ["step", "time", "loss", "nan"]
    assert line["step"] == 0 and line["loss"] == 0.5 and line["nan"] != line["nan"]


def test_resuming_drops_later_lines_and_continues_the_clock(tmp_path):
    run(tmp_path, range(5), quiet=True)
    path = tmp_path / "metrics.jsonl"
    lines = [line | {"time": 100.0 + line["step"]} for line in read_metrics(path)]
    cut_short = '{"step": 5, "ti'
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + cut_short)
    run(tmp_path, range(3, 6), start=3, quiet=True)
    metrics = read_metrics(path)
    assert [line["step"] for line in metrics] == [0, 1, 2, 3, 4, 5]
    assert metrics[:3] == lines[:3]
    assert 102.0 <= metrics[3]["time"] <= metrics[5]["time"] < 110.0


def test_a_run_from_the_start_begins_a_new_file(tmp_path):
    run(tmp_path, range(5), quiet=True)
    run(tmp_path, range(2), quiet=True)
    assert [line["step"] for line in read_metrics(tmp_path / "metrics.jsonl")] == [0, 1]


def test_a_pipe_shows_few_plain_lines(capsys):
    run(None, range(10))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("toy 1/10 eta 0:00:00  loss 1")
    assert lines[1].startswith("toy 10/10 eta 0:00:00  loss 0.1")


def test_messages_reach_stderr_unless_quiet(capsys):
    for quiet in (False, True):
        with Logger(None, total=1, title="toy", quiet=quiet) as log:
            log.message("saved [bold]")
    assert capsys.readouterr().err == "saved [bold]\n"


def test_a_terminal_shows_a_bar(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    run(None, range(10))
    shown = capsys.readouterr().err
    assert "toy" in shown and "10/10" in shown and "loss 0.1" in shown


def test_tensorboard_gets_the_scalars(tmp_path):
    pytest.importorskip("tensorboard")
    run(tmp_path, range(2), quiet=True)
    assert b"loss" in next((tmp_path / "tensorboard").iterdir()).read_bytes()


@pytest.mark.parametrize(
    ("metrics", "message"),
    [
        ({"step": 1.0}, "a metric may not be named 'step'"),
        ({"loss": torch.ones(2)}, "metric 'loss' must be a single number, not tensor"),
        ({"loss": "low"}, "metric 'loss' must be a single number, not 'low'"),
    ],
)
def test_write_messages(metrics, message):
    with Logger(None, total=1, title="toy", quiet=True) as log, pytest.raises(ValueError, match=message):
        log.write(0, metrics)


@pytest.mark.parametrize(
    ("text", "message"),
    [("{\n{}\n", r":1: not JSON"), ('{"step": 0, "time": 0}\n[]\n', r":2: expected an object with 'step'")],
)
def test_read_messages(tmp_path, text, message):
    (tmp_path / "metrics.jsonl").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_metrics(tmp_path / "metrics.jsonl")
