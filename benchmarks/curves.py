"""Plot what a training logged: its evaluations over samples, one panel a figure, one line a run.

python benchmarks/curves.py runs/a/distill runs/b/distill --out docs/curves.png
python benchmarks/curves.py cola=runs/0 cola=runs/1 lora=runs/lora --show eval/success_rate,eval/return --out target.png
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

from kinetok.logger import read_metrics

LABELS = {
    "track/success": "success, share of episodes",
    "track/mpjpe_mm": "MPJPE, mm",
    "eval/success_rate": "targets reached, share",
    "eval/final_distance_m": "final distance, m",
    "eval/return": "return, 20 s",
    "eval/velocity_error_mps": "velocity error, m/s",
    "eval/heading_error_rad": "heading error, rad",
    "eval/path_distance_m": "distance to the path, m",
}


def plot(runs: list[str], shown: list[str], out: Path) -> None:
    """runs: directories, or NAME=directory, of which those of one name share a colour; shown: keys of metrics.jsonl."""
    colours: dict[str, str] = {}
    figure, panels = plt.subplots(len(shown), 1, figsize=(7, 3 * len(shown)), sharex=True, squeeze=False)
    for run in runs:
        name, _, place = run.rpartition("=")
        name = name or "/".join(Path(place).parts[-3:])
        told = None if name in colours else name
        colour = colours.setdefault(name, f"C{len(colours)}")
        lines = list(read_metrics(Path(place) / "metrics.jsonl"))
        for axes, key in zip(panels[:, 0], shown, strict=True):
            points = [(line["step"] / 1e6, line[key]) for line in lines if key in line]
            if not points:
                raise SystemExit(f"{place}/metrics.jsonl holds no {key}")
            axes.plot(*zip(*points, strict=True), label=told, color=colour)
    for axes, key in zip(panels[:, 0], shown, strict=True):
        axes.set_ylabel(LABELS.get(key, key))
        axes.grid(alpha=0.3)
        axes.set_ylim(bottom=0)
    panels[-1, 0].set_xlabel("control steps, millions")
    panels[0, 0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(out, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="directories that hold a metrics.jsonl, each with or without a NAME=")
    parser.add_argument("--show", default="track/success,track/mpjpe_mm", help="what to plot, by its key in there")
    parser.add_argument("--out", type=Path, required=True, help="PNG to write")
    options = parser.parse_args()
    plot(options.runs, options.show.split(","), options.out)


if __name__ == "__main__":
    main()
