"""Plot what a training logged: success and error of its evaluations over samples, one line per run.

python benchmarks/curves.py runs/a/distill runs/b/distill --out docs/curves.png
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

from kinetok.logger import read_metrics


def plot(runs: list[Path], out: Path) -> None:
    """One panel for the share of episodes that succeed, one for MPJPE in mm."""
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(7, 6), sharex=True)
    for run in runs:
        lines = [line for line in read_metrics(run / "metrics.jsonl") if "track/success" in line]
        samples = [line["step"] / 1e6 for line in lines]
        name = "/".join(run.parts[-3:])
        upper.plot(samples, [100 * line["track/success"] for line in lines], label=name)
        lower.plot(samples, [line["track/mpjpe_mm"] for line in lines], label=name)
    upper.set_ylabel("success, % of episodes")
    lower.set_ylabel("MPJPE, mm")
    lower.set_xlabel("samples, millions")
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
        axes.set_ylim(bottom=0)
    upper.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(out, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="directories that hold a metrics.jsonl")
    parser.add_argument("--out", type=Path, required=True, help="PNG to write")
    options = parser.parse_args()
    plot(options.runs, options.out)


if __name__ == "__main__":
    main()
