"""JSONL, TensorBoard and a progress bar behind one `write(step, metrics)`.

    with Logger(out, total=config.iterations, title="tracker", start=start) as log:
        for step in range(start, config.iterations):
            log.write(step, {"reward": 0.7, "loss": 0.1})

`out/metrics.jsonl` gets one object a line with "step" and "time" (seconds of training, all sessions
together), in JSON as Python writes it: NaN and Infinity are left readable. `out/tensorboard` gets the same if
TensorBoard is installed. The terminal gets a progress bar; a pipe gets a plain line at most every 10 seconds.
Both go to stderr.

Lines of `step >= start` left by an earlier run are dropped, so a run that starts at 0 begins a new file.
Refuses metrics named "step" or "time" and values that are not single numbers. `out=None` writes no file.
"""

import json
import os
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

PLAIN_EVERY = 10.0  # seconds between lines where there is no terminal
SHOWN = 5  # metrics on the progress line; the files get all of them


class Logger:
    """One training run's record.

    out: the run's directory, or None for no files. total: steps of the whole run. title: name on the progress
    line. start: first step to be written (a resumed run's next step). stride: how far apart the steps are: 1 counts
    steps from 0, more counts samples done. quiet: files only.
    """

    def __init__(
        self, out: Path | None, *, total: int, title: str, start: int = 0, stride: int = 1, quiet: bool = False
    ):
        self.total, self.title, self.start, self.stride, self.quiet = total, title, start, stride, quiet
        self._began = self._told = time.monotonic()
        self._before = 0.0
        self._file: TextIO | None = None
        self._board: Any = None
        if out is not None:
            self._open(Path(out))
        self._progress = None if quiet else _progress(title, start, total)

    def write(self, step: int, metrics: dict[str, float]) -> None:
        """Record the metrics of one finished step and advance the progress line."""
        elapsed = time.monotonic() - self._began
        values = {key: _number(key, value) for key, value in metrics.items()}
        if self._file:
            line = {"step": step, "time": round(self._before + elapsed, 3)} | values
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()
        if self._board:
            for key, value in values.items():
                self._board.add_scalar(key, value, step)
        if not self.quiet:
            self._show(step, values, elapsed)

    def message(self, text: str) -> None:
        """Print a line to stderr, above the progress bar; not when quiet."""
        if self._progress:
            self._progress.console.print(text, markup=False, highlight=False)
        elif not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Close the files and leave the terminal as it was; may be called twice."""
        if self._progress:
            self._progress.stop()
        if self._board:
            self._board.close()
        if self._file:
            self._file.close()
        self._progress = self._board = self._file = None

    def __enter__(self) -> "Logger":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self, out: Path) -> None:
        out.mkdir(parents=True, exist_ok=True)
        path = out / "metrics.jsonl"
        if path.exists():
            kept = [line for line in read_metrics(path) if line["step"] < self.start]
            self._before = kept[-1]["time"] if kept else 0.0
            _rewrite(path, kept)
        self._file = open(path, "a", encoding="utf-8")  # noqa: SIM115
        self._board = _board(out / "tensorboard", self.start)

    def _show(self, step: int, values: dict[str, float], elapsed: float) -> None:
        done, count = step + self.stride - self.start, min(step + (self.stride == 1), self.total)
        left = elapsed / max(done, 1) * max(self.total - count, 0)
        shown = " ".join(f"{key} {value:.4g}" for key, value in list(values.items())[:SHOWN])
        if self._progress:
            self._progress.update(self._progress.task_ids[0], completed=count, note=f"eta {_clock(left)}  {shown}")
        elif count >= self.total or step == self.start or time.monotonic() - self._told >= PLAIN_EVERY:
            self._told = time.monotonic()
            self.message(f"{self.title} {count}/{self.total} eta {_clock(left)}  {shown}")


def read_metrics(path: Path | str) -> list[dict[str, Any]]:
    """The lines of a metrics.jsonl, in order. A last line cut short by a crash is left out.

    Any other line that is not an object with "step" and "time" raises ValueError with its number.
    """
    text = Path(path).read_text(encoding="utf-8")
    lines = text.split("\n")[:-1]
    return [_parse(line, f"{path}:{number}") for number, line in enumerate(lines, start=1)]


def _parse(line: str, where: str) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except ValueError as error:
        raise ValueError(f"{where}: not JSON ({error}); move the file away to start a new one") from error
    if not isinstance(record, dict) or not {"step", "time"} <= record.keys():
        raise ValueError(f"{where}: expected an object with 'step' and 'time', not {line[:80]!r}")
    return record


def _number(key: str, value: Any) -> float:
    if key in ("step", "time"):
        raise ValueError(f"a metric may not be named {key!r}: the log writes that key itself")
    try:
        return float(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"metric {key!r} must be a single number, not {value!r}") from error


def _rewrite(path: Path, lines: list[dict[str, Any]]) -> None:
    draft = path.with_name(f".{path.name}.tmp")
    draft.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    os.replace(draft, path)


def _board(path: Path, start: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(path), purge_step=start)


def _progress(title: str, start: int, total: int) -> Progress | None:
    console = Console(stderr=True)
    if not console.is_terminal:
        return None
    columns = (
        TextColumn(title),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    progress = Progress(*columns, console=console)
    progress.add_task(title, total=total, completed=start, note="")
    progress.start()
    return progress


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
