"""Benchmarks: each prints ratios measured in one run, on the machine it runs on.

    python benchmarks/run.py                       # all of them
    python benchmarks/run.py env_step --json out.json

A benchmark is a function (clip path) -> dict of plain numbers, registered in BENCHMARKS; run alone, its figures stand
at the top level of the JSON file, else under its name. Sides of a ratio are
measured in turns and the median of the paired ratios is reported: rates drift on a shared machine, ratios far less.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: spinning threads take the physics threads' cores

import argparse
import json
import platform
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from library import library  # benchmarks/library.py
from mujoco.batch import Batch

from kinetok import presets
from kinetok.logger import read_metrics
from kinetok.motion.formats import read_deepmimic
from kinetok.motion.library import ClipLibrary
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers.fit import fit
from kinetok.tokenizers.tokenizer import MotionTokenizer

CLIP = Path(__file__).parents[2] / "shared" / "data" / "train" / "deepmimic" / "humanoid3d_walk.txt"


def seconds(work: Callable[[], object]) -> float:
    """Wall-clock time of one call."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def env_step(clip: Path, rows: int, *, steps: int = 150, skip: int = 20) -> dict[str, float]:
    """Env.step (physics, observation, reward, resets) against Batch.step alone, and against Gymnasium's loop.

    The packaged tokenizer drives the worlds, so that they walk as they do in training; its own time is not counted.
    At every control step the raw batch of the same model, threads and substeps starts from the same states under the
    same controls; `current`: and brings all that follows from positions and velocities, contacts and forces too, up to
    the last substep, of which an observation needs where the bodies are. The default window of seven future frames is
    observed; 10 s episodes keep resets in the figures.
    """
    tokenizer = MotionTokenizer.from_pretrained("humanoid-fsq")
    table = ReferenceTable(ClipLibrary.of([read_deepmimic(clip)]))
    task = Tracking(TrackingConfig(future=tokenizer.config.future), table, rows=rows)
    config = EnvConfig()
    env = Env(config, task, rows=rows)
    raw = Batch(env.sim.model, rows)
    state = {name: raw.bind(name) for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")}
    start = np.empty_like(state["qpos"]), np.empty_like(state["qvel"])
    gym = gymnasium.make("Humanoid-v5")
    gym.reset(seed=0)
    gym.action_space.seed(0)
    gym_actions = [gym.action_space.sample() for _ in range(20)]
    finished, samples = 0, []

    def step_gym() -> None:
        for action in gym_actions:
            _, _, terminated, truncated, _ = gym.step(action)
            if terminated or truncated:
                gym.reset()

    def step_raw(action: np.ndarray, **stage: int) -> float:
        state["qpos"][:], state["qvel"][:], state["qacc_warmstart"][:], state["ctrl"][:] = *start, 0, action
        return seconds(lambda: raw.step(nstep=config.scene.substeps, **stage))

    obs = env.reset(spread=True)
    for index in range(steps + skip):
        with torch.no_grad():
            action = tokenizer.act(torch.from_numpy(obs))[0].numpy()
        start[0][:], start[1][:] = env.sim.qpos, env.sim.qvel
        before = step_raw(action) if index % 2 else None
        begin = time.perf_counter()
        step = env.step(action)
        took = time.perf_counter() - begin
        after = before or step_raw(action)
        obs, finished = step.obs, finished + len(step.done)
        current = step_raw(action, stage=mujoco.mjtStage.mjSTAGE_VEL)
        samples.append((after, current, took, seconds(step_gym) / len(gym_actions)))
    raw_s, current_s, env_s, gym_s = np.array(samples[skip:]).T
    return {
        "rows": rows,
        "observation": env.obs_size,
        "env_steps_per_second": rows / float(np.median(env_s)),
        "raw_steps_per_second": rows / float(np.median(raw_s)),
        "gymnasium_steps_per_second": 1 / float(np.median(gym_s)),
        "ratio_to_raw": float(np.median(raw_s / env_s)),
        "ratio_to_current": float(np.median(current_s / env_s)),
        "ratio_to_gymnasium": float(np.median(gym_s * rows / env_s)),
        "episodes_finished": finished,
    }


def env_steps(clip: Path) -> dict[str, object]:
    """The figures at 1,024 rows, and at fewer for comparison."""
    return {**env_step(clip, 1024), "fewer_rows": env_step(clip, 512)}


def reached(out: Path, stage: str, done: Callable[[dict], bool]) -> dict[str, float] | None:
    """Minutes and samples of the first evaluation in a stage's log that satisfies `done`."""
    for line in read_metrics(out / stage / "metrics.jsonl"):
        if "track/success" in line and done(line):
            return {"minutes": line["time"] / 60, "samples": line["step"]}
    return None


def one_clip(clip: Path, seeds: int = 3) -> dict[str, object]:
    """A tokenizer of one walk from nothing: time and samples to 95 % of 20 s episodes, and to MPJPE below 40 mm.

    The distilled student's time counts from the start of its teacher. Runs are kept in runs/bench-one-clip-SEED.
    """
    runs = []
    for seed in range(seeds):
        out = Path("runs") / f"bench-one-clip-{seed}"
        shutil.rmtree(out, ignore_errors=True)
        began = time.monotonic()
        fit([read_deepmimic(clip)], presets.one_clip(), out, seed=seed)
        total = (time.monotonic() - began) / 60
        teacher = f"teachers/{read_deepmimic(clip).name}"
        before = read_metrics(out / teacher / "metrics.jsonl")[-1]
        run: dict[str, object] = {"seed": seed, "minutes": total, "teacher_samples": before["step"]}
        run["teacher_95"] = reached(out, teacher, lambda line: line["track/success_mean_error"] >= 0.95)
        for name, done in (
            ("tokenizer_95", lambda line: line["track/success_mean_error"] >= 0.95),
            ("tokenizer_40mm", lambda line: line["track/mpjpe_mm"] < 40 and line["track/success"] >= 0.95),
        ):
            found = reached(out, "distill", done)
            run[name] = found and {
                "minutes": before["time"] / 60 + found["minutes"],
                "samples": before["step"] + found["samples"],
            }
        last = [line for line in read_metrics(out / "distill" / "metrics.jsonl") if "track/success" in line]
        run["best_mpjpe_mm"] = min(line["track/mpjpe_mm"] for line in last)
        print(json.dumps(run), flush=True)
        runs.append(run)
    return {"runs": runs}


BENCHMARKS: dict[str, Callable[[Path], dict[str, object]]] = {"env_step": env_steps, "one_clip": one_clip}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"which to run: {', '.join(BENCHMARKS)}; all when none is named")
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--clip", type=Path, default=CLIP, help="a DeepMimic walk")
    parser.add_argument("--scratch", type=Path, help="a folder with room for a library of --hours, for `library`")
    parser.add_argument("--hours", type=float, nargs="+", default=[1, 10], help="sizes of that library; 680 are 6.8 GB")
    options = parser.parse_args()
    table = dict(BENCHMARKS)
    if options.scratch:
        table["library"] = lambda _: library(options.scratch, options.hours)
    unknown = set(options.names) - set(table)
    if unknown:
        parser.error(f"unknown benchmark {sorted(unknown)}; there are: {', '.join(table)}, and library with --scratch")
    if not options.clip.exists():
        raise SystemExit(f"skipped: no clip at {options.clip}; give a DeepMimic walk with --clip")
    names = options.names or list(table)
    results: dict[str, object] = {
        "machine": {"cpus": os.cpu_count(), "load": os.getloadavg()[0], "python": platform.python_version()},
        "mujoco": mujoco.__version__,
    }
    for name in names:
        figures = table[name](options.clip)
        print(f"{name}: {json.dumps(figures, indent=2)}")
        results |= figures if len(names) == 1 else {name: figures}
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
