"""What each stage of `kinetok tokenize fit` buys, on the same clips: success, MPJPE, and what survives pushes.

    python benchmarks/stages.py CLIP... --runs runs/stages --json stages.json --threads 1

Trains a teacher for each clip, the student distilled from them, the student polished end to end, and the paper's
form, end to end from nothing, with one seed; each is the best of its run by unpushed tracking. A folder that is there
already is gone on with. All are evaluated by `kinetok evaluate tracking`'s function.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import json
from dataclasses import replace
from pathlib import Path

from kinetok.config import override
from kinetok.evaluate import evaluate_tracking
from kinetok.logger import read_metrics
from kinetok.motion.clip import Clip
from kinetok.motion.formats import read_clips
from kinetok.presets import FIT
from kinetok.tokenizers.fit import STAGES, fit
from kinetok.tokenizers.tokenizer import MotionTokenizer

PUSHES = (0.0, 0.5, 1.0)  # m/s every two seconds


def spent(out: Path) -> dict[str, float]:
    """Control steps and minutes of a stage's run."""
    last = read_metrics(out / "metrics.jsonl")[-1]
    return {"samples": last["step"], "minutes": last["time"] / 60}


def judge(tokenizer: Path, clips: list[Clip], episodes: int, seed: int, threads: int) -> dict[str, dict[str, float]]:
    """Scores by push."""
    scores = {}
    for push in PUSHES:
        score = evaluate_tracking(
            MotionTokenizer.from_pretrained(tokenizer), clips, episodes=episodes, seed=seed, push=push, threads=threads
        )
        scores[f"{push:g}"] = {name: score[name] for name in ("success_rate", "survival_rate", "mpjpe_mm")}
    return scores


def stages(clips: list[Clip], runs: Path, *, preset: str, episodes: int, seed: int, threads: int) -> dict[str, dict]:
    """Train what is not trained yet, then score each stage on all clips; a teacher on its own clip, averaged."""
    chain, scratch = runs / "chain", runs / "scratch"
    fit(clips, replace(FIT[preset](), stages=STAGES), chain, seed=seed, threads=threads)
    config = replace(FIT["from-scratch"](), tokenizer=FIT[preset]().tokenizer)
    config = override(config, ["tokenizer.quantizer.unit=true"])
    fit(clips, config, scratch, seed=seed, threads=threads)
    table = {}
    teachers = [chain / "teachers" / clip.name for clip in clips]
    own = [judge(path, [clip], episodes, seed, threads) for path, clip in zip(teachers, clips, strict=True)]
    table["teacher"] = {
        push: {name: sum(score[push][name] for score in own) / len(own) for name in own[0][push]} for push in own[0]
    } | {name: sum(spent(path)[name] for path in teachers) for name in ("samples", "minutes")}
    for name, place in (("distill", chain / "distill"), ("ppo", chain / "ppo"), ("from scratch", scratch / "ppo")):
        table[name] = judge(place, clips, episodes, seed, threads) | spent(place)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the trainings; gone on with if it is there")
    parser.add_argument("--preset", default="one-clip", choices=["one-clip", "many-clips", "tiny"])
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    clips = [clip for path in options.clips for clip in read_clips(path)]
    told = {name: getattr(options, name) for name in ("preset", "episodes", "seed", "threads")}
    table = stages(clips, options.runs, **told)
    for name, row in table.items():
        plain, *pushed = (row[f"{push:g}"] for push in PUSHES)
        survived = ", ".join(f"{score['survival_rate']:.0%}" for score in pushed)
        print(
            f"{name}: success {plain['success_rate']:.0%}, {plain['mpjpe_mm']:.0f} mm; survival of pushes {survived}; "
            f"{row['samples']:,.0f} samples, {row['minutes']:.1f} min"
        )
    if options.json:
        options.json.write_text(json.dumps(told | {"stages": table}, indent=2) + "\n")


if __name__ == "__main__":
    main()
