"""Numbers with a seed: how well a tokenizer tracks, and how long, how smoothly and how variously a prior moves.

    evaluate_tracking(tokenizer, clips, episodes=8, seed=0)      # success, MPJPE, use of the tokens
    evaluate_prior(prior, episodes=64, seconds=20, push=2.4)     # survival, APD, acceleration, jerk
    measure(roll(prior, rows=1, seconds=10))                     # the same of any recording

JSON-able dicts; what is not defined (no foot on the ground, one rollout) is None. The results depend on the
seed, not on the number of threads.

Survival is GPC's (app. C.3): the root is above 0.5 m when the time is over, whatever falls came before, and the
simulation has not blown up. A character that crawls or lies by intent does not survive by this rule, so
`evaluate_prior` also gives the rate over episodes that began upright and over those of each start's clip.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from kinetok import metrics
from kinetok.adapters.rlft import Controller, TokenPolicy, play
from kinetok.adapters.skill import Skill
from kinetok.config import ConfigError, pick
from kinetok.gpt.controller import Prior, PriorController, Recording, roll
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import kinematics, lowest_point
from kinetok.motion.library import ClipLibrary
from kinetok.rl.rollout import seeded
from kinetok.sim.tasks import TASKS
from kinetok.sim.tasks.tracking import ReferenceTable
from kinetok.tokenizers.tokenizer import MotionTokenizer, require_character
from kinetok.tokenizers.track import track

UPRIGHT = 0.5  # metres, of the root
POSES = 15  # starting poses (GPC app. C.3)
ON_GROUND = 0.03  # metres above where a foot stands


def evaluate_tracking(
    tokenizer: MotionTokenizer,
    clips: Sequence[Clip],
    *,
    episodes: int = 8,
    seed: int = 0,
    push: float = 0.0,
    from_start: bool = False,
    threads: int = 0,
) -> dict[str, Any]:
    """Track every clip `episodes` times with mean actions; see tokenizers.track for episodes, success and error.

    Means over clips, and `clips` with the numbers of each. utilisation, perplexity: of each token position over all
    control steps, None for a continuous tokenizer. push: m/s at the root, every two seconds.
    """
    config, library = tokenizer.config, ClipLibrary.of(clips)
    require_character(library, config.character)
    table = ReferenceTable(library, control_hz=config.scene.control_hz)
    codes: list[Tensor] = []
    score = track(
        tokenizer,
        table,
        future=config.future,
        scene=config.scene,
        episodes=episodes,
        push=push,
        from_start=from_start,
        threads=threads,
        seed=seed,
        seen=(lambda obs: codes.append(tokenizer.encode(obs))) if tokenizer.quantizer.levels else None,
    )
    columns = ("success", "success_mean_error", "survival", "mpjpe_mm", "mpjpe_local_mm", "seconds")
    return {
        "success_rate": float(score.success.mean()),
        "success_rate_mean_error": float(score.success_mean_error.mean()),
        "survival_rate": float(score.survival.mean()),
        "mpjpe_mm": float(score.mpjpe_mm.mean()),
        "mpjpe_local_mm": float(score.mpjpe_local_mm.mean()),
        "clips": [
            {"name": name} | {column: float(getattr(score, column)[k]) for column in columns}
            for k, name in enumerate(score.names)
        ],
        "utilisation": None,
        "perplexity": None,
        "episodes": episodes,
        "push_mps": push,
        "from_start": from_start,
        "seed": seed,
    } | (
        _usage(tokenizer.layout.to_tokens(torch.cat(codes)).numpy(force=True), tokenizer.layout.vocabulary)
        if codes
        else {}
    )


def evaluate_prior(
    prior: Prior,
    *,
    episodes: int = 64,
    seconds: float = 20.0,
    push: float = 0.0,
    seed: int = 0,
    top_p: float = 0.9,
    temperature: float = 1.0,
    threads: int = 0,
) -> dict[str, Any]:
    """`measure` of free rollouts, with apd_m (root path) and apd_pose_m (all bodies): means over starting poses.

    The episodes are dealt out over 15 poses (fewer below 30 episodes, so that each has two), of as many clips as
    there are. push: m/s, once, at step 200.
    """
    poses = starting_poses(prior, min(POSES, max(episodes // 2, 1)), seed)
    recording = roll(
        prior,
        rows=episodes,
        seconds=seconds,
        starts=poses[np.arange(episodes) % len(poses)],
        seed=seed,
        push=push,
        top_p=top_p,
        temperature=temperature,
        threads=threads,
    )
    groups = [np.flatnonzero(recording.start == pose) for pose in poses]
    pos = rearrange(recording.pos, "t n b x -> n t b x")
    alive, clip = survived(recording), prior.starts.clip[recording.start]
    upright = recording.pos[0, :, 0, 2] > UPRIGHT
    return measure(recording) | {
        "survival_rate_upright_starts": _mean(alive[upright].tolist()),
        "apd_m": _apd([pos[ids, :, 0, :2] for ids in groups]),
        "apd_pose_m": _apd([pos[ids].reshape(len(ids), len(recording.pos), -1) for ids in groups]),
        "start_clips": [
            {
                "name": prior.clips[k],
                "episodes": int((clip == k).sum()),
                "survival_rate": float(alive[clip == k].mean()),
            }
            for k in np.unique(clip)
        ],
        "starting_poses": len(poses),
        "push_mps": push,
        "top_p": top_p,
        "temperature": temperature,
        "seed": seed,
    }


def evaluate_task(
    adapter: Path | str | None,
    prior: Path | str | None = None,
    task: str | None = None,
    *,
    tokenizer: Path | str | None = None,
    episodes: int = 256,
    seconds: float = 20.0,
    push: float = 0.0,
    top_p: float | None = None,
    temperature: float | None = None,
    seed: int = 0,
    threads: int = 0,
) -> dict[str, Any]:
    """Scores of a skill, or of a prior alone where adapter is None, on a task (sim.tasks; the skill's own if None).

    A Scorecard's measures: rewards, survival, and what the task defines, such as success_rate and final_distance_m,
    None where it never happened. push: m/s at the root, every two seconds. top_p, temperature: of the tokens, by
    default the skill's own, or 0.9 and 1. token_entropy, of a skill: nats of a control step, the mean surprise of
    the tokens that were drawn.
    """
    drawn: dict[str, Any] = {
        name: value for name, value in (("top_p", top_p), ("temperature", temperature)) if value is not None
    }
    if task is not None:
        pick(TASKS, task, "task")
    if adapter is not None:
        skill = Skill.from_pretrained(adapter, prior, tokenizer)
        skill = replace(skill, policy=replace(skill.policy, **drawn))
        config, model = skill.task, skill.prior
        controller = surprised = _Surprised(TokenPolicy(skill.adapted, model.tokenizer, skill.policy), seeded(seed))
        if task not in (None, config.kind):
            raise ConfigError(f"{adapter} was bent to {config.kind!r} and cannot read what {task!r} asks")
    else:
        model, config = Prior.from_pretrained(prior or "humanoid-gpt", tokenizer), TASKS[task or "target"][0]()
        controller, surprised = _blind(PriorController(model, generator=seeded(seed), **drawn)), None
    played = play(controller, config, model, episodes=episodes, seconds=seconds, push=push, seed=seed, threads=threads)
    entropy = {} if surprised is None else {"token_entropy": float(torch.stack(surprised.nats).mean())}
    return played.score.measures | entropy | {"task": config.kind, "push_mps": push, "seed": seed} | drawn


class _Surprised:
    """A skill as it is played, and how unlikely what it drew was: nats, one number a control step."""

    def __init__(self, policy: TokenPolicy, generator: torch.Generator):
        self.policy, self.generator = policy, generator
        self.nats: list[Tensor] = []

    def __call__(self, obs: Tensor) -> Tensor:
        action, drawn = self.policy.draw(obs, self.generator)
        self.nats.append(-drawn["log_prob"].mean())
        return action


def _blind(alone: PriorController) -> Controller:
    """A prior that does not see what the task asks."""
    return lambda obs: alone.act(obs[:, : alone.prior.gpt.config.state_dim])[0]


def measure(recording: Recording) -> dict[str, Any]:
    """What one recording tells of itself: survival, falls, smoothness (means over rows), skating, token use."""
    body = Character.load(recording.character)
    rows = rearrange(recording.pos, "t n b x -> n t b x")
    fps, root = recording.fps, rows[:, :, 0, 2]
    feet = rows[:, :, body.bodies("feet")]
    ground = standing_foot_height(body) + ON_GROUND
    return {
        "survival_rate": float(survived(recording).mean()),
        "never_fell_rate": float(((root > UPRIGHT).all(1) & ~recording.blown_up).mean()),
        "seconds": len(recording.pos) / fps,
        "episodes": len(rows),
        "accel_mps2": _mean([metrics.mean_acceleration(row, fps) for row in rows]),
        "jerk": _mean([metrics.normalized_jerk(row, fps) for row in rows]),
        "foot_jerk": _mean([metrics.normalized_jerk(row, fps) for row in feet]),
        "foot_skate_mps": _mean([metrics.foot_skate(row, ground, fps) for row in feet]),
        "path_m": _mean([np.linalg.norm(np.diff(row[:, 0, :2], axis=0), axis=-1).sum() for row in rows]),
        "blown_up": int(recording.blown_up.sum()),
    } | _usage(rearrange(recording.tokens, "t n s -> (t n) s"), recording.vocabulary)


def survived(recording: Recording) -> np.ndarray:
    """Rows (N,) bool whose root is above 0.5 m at the end and whose simulation has not blown up."""
    return (recording.pos[-1, :, 0, 2] > UPRIGHT) & ~recording.blown_up


def starting_poses(prior: Prior, count: int, seed: int) -> np.ndarray:
    """Indices (count,) of distinct start states: random ones of clips in random order, each clip before any twice."""
    order = np.random.default_rng([seed, 3]).permutation(len(prior.starts.clip))
    clip = prior.starts.clip[order]
    turn = np.array([(clip[:i] == k).sum() for i, k in enumerate(clip)])  # how often a start's clip came before it
    return order[np.argsort(turn, kind="stable")][:count]


def standing_foot_height(body: Character) -> float:
    """Height in metres of the foot bodies' origins above the sole, in the pose of the MJCF."""
    qpos = np.repeat(body.model.qpos0[None], 2, axis=0)
    feet = kinematics(body, qpos, 1.0).xpos[0, body.bodies("feet"), 2]
    return float(feet.min() - lowest_point(body, qpos)[0])


def _usage(tokens: np.ndarray, vocabulary: int) -> dict[str, list[float]]:
    """utilisation and perplexity of tokens (N, S), by position."""
    return {
        "utilisation": metrics.utilisation(tokens, vocabulary).tolist(),
        "perplexity": metrics.perplexity(tokens, vocabulary).tolist(),
    }


def _apd(groups: Sequence[np.ndarray]) -> float | None:
    return _mean([metrics.apd(rollouts) for rollouts in groups if len(rollouts) > 1])


def _mean(values: Sequence[float]) -> float | None:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else None
