"""Measure a tracker: roll it over clips and say which it can follow.

    score = track(tokenizer, table, episodes=8, seconds=20)
    score.success.mean(), score.mpjpe_mm.mean()

An episode of a loop runs `seconds`, from phases spread evenly over the cycle, the first of them drawn by the seed (or
all from its first frame, as papers do: from a frame in mid-leap a recorded velocity may lead nowhere); an episode of
any other clip runs from its first frame to its end. Start poses are disturbed by 0.01 rad, so that episodes differ. An
episode has failed when the mean body error exceeds 0.5 m, or is not a number in a blown-up simulation, and then ends
early. Under pushes it goes on until it falls as well: who was pushed away and walks on has lost its place, not its
balance.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kinetok.rl.nets import Actor
from kinetok.rl.rollout import torch_threads
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.scene import SceneConfig
from kinetok.sim.tasks.tracking import Failure, ReferenceTable, Tracking, TrackingConfig, lengths

THRESHOLD = 0.5
FALL = 0.4  # metres of the root's height from its reference's
START_NOISE = 0.01


@dataclass(frozen=True, kw_only=True)
class TrackingScore:
    """Per clip (K,): success, the share of episodes whose largest body error stayed below 0.5 m; success_mean_error,
    the same of the mean body error; survival, the share that never fell, without pushes the same; mpjpe_mm over
    all frames until a failure, in the world's frame (the G-MPJPE of some papers); mpjpe_local_mm, the same from the
    root (their MPJPE); seconds until it (mean form); limit: seconds that its episodes could last."""

    names: tuple[str, ...]
    success: np.ndarray
    success_mean_error: np.ndarray
    survival: np.ndarray
    mpjpe_mm: np.ndarray
    mpjpe_local_mm: np.ndarray
    seconds: np.ndarray
    limit: np.ndarray
    episodes: int

    @property
    def merit(self) -> float:
        """One number for keeping the best checkpoint: success counts most, then the share survived, then the error.

        Under pushes who was lost and did not fall counts as much as who succeeded.
        """
        survived = self.seconds / np.maximum(self.limit, 1e-6)
        lost = self.survival - self.success_mean_error
        return float((self.success + lost + 0.2 * survived - np.minimum(self.mpjpe_mm, 500) / 1000).mean())

    def summary(self) -> dict[str, float]:
        return {
            "success": float(self.success.mean()),
            "success_mean_error": float(self.success_mean_error.mean()),
            "survival": float(self.survival.mean()),
            "mpjpe_mm": float(self.mpjpe_mm.mean()),
            "mpjpe_local_mm": float(self.mpjpe_local_mm.mean()),
            "seconds": float(self.seconds.mean()),
        }

    def to_json(self) -> dict:
        """Lists and numbers, exact; `from_json` reads them."""
        return {key: value if key == "episodes" else np.asarray(value).tolist() for key, value in vars(self).items()}

    @staticmethod
    def from_json(data: dict) -> "TrackingScore":
        """Scores from before limits were kept take the longest clip's seconds for every clip's, as they did then; an
        error from the root that was not kept is NaN."""
        longest, unknown = ([value] * len(data["seconds"]) for value in (max(data["seconds"]), np.nan))
        data = {"limit": longest, "survival": data["success_mean_error"], "mpjpe_local_mm": unknown} | data
        arrays = {key: np.array(value) for key, value in data.items() if key not in ("names", "episodes")}
        return TrackingScore(names=tuple(data["names"]), episodes=data["episodes"], **arrays)


def track(
    actor: Actor,
    table: ReferenceTable,
    *,
    future: tuple[int, ...],
    scene: SceneConfig | None = None,
    episodes: int = 8,
    seconds: float = 20.0,
    push: float = 0.0,
    push_seconds: float = 2.0,
    from_start: bool = False,
    threads: int = 0,
    seed: int = 0,
    seen: Callable[[Tensor], None] | None = None,
) -> TrackingScore:
    """Score an actor on every clip of a table. from_start: loops begin at their first frame alone. seen: told at every
    step what the rows observe whose episodes go on."""
    clips = len(table.names)
    fixed = np.repeat(np.arange(clips), episodes)
    begin = np.random.default_rng([seed, 5]).random()
    share = np.tile((np.arange(episodes) + begin) / episodes, clips) * (not from_start)
    loops = table.last - table.first > table.cycle
    starts = (share * np.where(loops, table.cycle, 0)[fixed]).astype(int)
    rows = len(fixed)
    config = TrackingConfig(future=future, failure=Failure(largest=np.inf, mean=np.inf))
    task = Tracking(config, table, rows=rows, fixed=fixed, starts=starts)
    env_config = EnvConfig(
        scene=scene or SceneConfig(),
        episode_seconds=float(max(seconds, table.cycle.max() / table.control_hz)) + 1,
        reset_noise=START_NOISE,
        push=push,
        push_seconds=push_seconds,
        push_regular=True,
        autoreset=False,
    )
    env = Env(env_config, task, rows=rows, threads=threads, seed=seed)
    left = (table.last - table.first)[fixed] - starts
    limit = np.where(loops[fixed], np.minimum(round(seconds * table.control_hz), left), left)
    running, failed, fallen = np.ones(rows, bool), np.zeros(rows, bool), np.zeros(rows, bool)
    largest, total, local = np.zeros(rows), np.zeros(rows), np.zeros(rows)
    frames, steps = np.zeros(rows), 0
    obs = env.reset()
    with torch.no_grad(), torch_threads(1):
        while running.any():
            counts = running & ~failed
            if seen and counts.any():
                seen(torch.as_tensor(obs[counts]))
            step = env.step(actor.act(torch.as_tensor(obs))[0].numpy(force=True))
            obs, steps = step.obs, steps + 1
            offset = task.offset[counts]
            error, apart = (
                np.nan_to_num(lengths(o), nan=np.inf, posinf=np.inf) for o in (offset, offset - offset[:, :1])
            )
            largest[counts] = np.maximum(largest[counts], error.max(1))
            total[counts] += np.minimum(error.mean(1), 1.0)
            local[counts] += np.minimum(apart.mean(1), 1.0)
            frames[counts] += 1
            failed[counts] = step.terminated[counts] | (error.mean(1) > THRESHOLD)
            height = np.abs(env.sim.qpos[:, 2] - task.table.root[task.frame, 2])
            fallen |= running & (step.terminated | (height > FALL) if push else failed)
            running &= ~(fallen | step.truncated) & (steps < limit)

    def per_clip(values: np.ndarray) -> np.ndarray:
        return values.reshape(clips, episodes).mean(1)

    return TrackingScore(
        names=table.names,
        success=per_clip(~failed & (largest < THRESHOLD)),
        success_mean_error=per_clip(~failed),
        survival=per_clip(~fallen),
        mpjpe_mm=1000 * per_clip(total) / per_clip(frames),
        mpjpe_local_mm=1000 * per_clip(local) / per_clip(frames),
        seconds=per_clip(frames) / table.control_hz,
        limit=per_clip(limit) / table.control_hz,
        episodes=episodes,
    )
