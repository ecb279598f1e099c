"""Hindsight fine-tuning: what the character did is what it was asked to do.

    hindsight(policy, env, HindsightConfig(), out, evaluate=evaluate, keep=keep, identity=identity, seed=0)

A motion that was made for no task at all came somewhere. Every step of it is relabelled with a task observation that
the following seconds fulfilled (a target it reached, a velocity it had, a path it took), and the adapter learns by
cross-entropy to choose the tokens that were chosen, given that observation. No reward and no critic: the variety of
the motion is the teacher. Steps before a fall are left out, so that what remains upright is learned.

Two sources of motion: recorded clips, which the frozen tokenizer tracks, and the policy itself, which plays the task
round after round. Clips are played as the task asks, by motion matching (`matching`), where nothing has to be
relabelled, or as they are. Relabelling alone has brought no skill (docs/log.md): most of what is learned follows from
the state, and little from what was asked. Matched demonstrations have.

Goal-conditioned supervised learning (Ghosh et al. 2021, "Learning to reach goals via iterated supervised
learning"; of demonstrations, Ding et al. 2019, "Goal-conditioned imitation learning"), which GPC does not use:
reinforcement learning goes on from there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from kinetok import rotation
from kinetok.adapters.adapted import AdapterPart
from kinetok.adapters.guide import demonstrate
from kinetok.adapters.rlft import TokenPolicy
from kinetok.config import to_dict
from kinetok.gpt.data import Rollout, before_failure, roam
from kinetok.logger import Logger
from kinetok.resume import State
from kinetok.rl.rollout import seeded, torch_threads
from kinetok.rl.training import Score
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks import Goal
from kinetok.sim.tasks.tracking import ReferenceTable

S = TypeVar("S", bound=Score)


@dataclass(frozen=True, kw_only=True)
class HindsightConfig:
    """rounds: of learning, each of `iterations` of `batch` samples at lr, falling to a tenth over all rounds; rows,
    seconds: of the task played before each round, but for the first where there are clips; memory: rounds whose samples
    are kept; samples: control steps of tracked clips, which are kept all the time; matching: the clips are played as
    the task asks, by motion matching (guide.py), and not as they are; restless: range of seconds after which what is
    asked changes there, so soon that the motion so far says little about it; code_noise, transitions, env: of the
    tracking, as in recording for a prior; doomed: seconds before a fall that are left out; label_smoothing; sectors:
    directions of what was asked and of what was fulfilled are counted in so many, and samples drawn so that both are
    alike; boost: at most so much more often."""

    rounds: int = 5
    rows: int = 512
    seconds: float = 10.0
    iterations: int = 500
    batch: int = 512
    lr: float = 3e-3
    memory: int = 5
    samples: int = 250_000
    code_noise: float = 0.05
    matching: bool = True
    restless: tuple[float, float] = (0.4, 4.0)
    transitions: float = 0.1
    env: EnvConfig = EnvConfig(reset_noise=0.02, push=0.3, episode_seconds=20.0)
    doomed: float = 1.5
    label_smoothing: float = 0.0
    sectors: int = 16
    boost: float = 10.0


def hindsight(
    policy: TokenPolicy,
    env: Env,
    config: HindsightConfig,
    out: Path,
    *,
    evaluate: Callable[[], S],
    keep: Callable[[S], None],
    identity: dict,
    table: ReferenceTable | None = None,
    asking: Callable[[], Goal] | None = None,
    seed: int = 0,
    threads: int = 0,
    quiet: bool = False,
) -> None:
    """Adapt in place. After each round `evaluate` measures, and `keep` is called with the best score so far.

    table: the clips to learn from, if any, and asking: makes what they are matched to, anew each time; by default the
    task of env. `out` receives metrics.jsonl and a state from which a later call with the same identity goes on after
    the last round.
    """
    adapted, best, done = policy.adapted, -1e9, 0
    optimizer = torch.optim.Adam(adapted.trainable(), lr=config.lr, fused=True)
    generator = seeded(seed)
    parts = {"adapted": AdapterPart(adapted), "optimizer": optimizer, "generator": generator}
    state = State(out, parts, identity=identity | {"hindsight": to_dict(config)}, kinds={"hindsight": HindsightConfig})
    memory: list[tuple[Tensor, ...]] = []
    if before := state.restore():
        meta, kept = before
        memory, done, best = [tuple(part) for part in kept["memory"]], meta["round"], meta["best"]
    total = config.rounds * config.iterations
    lessons = []
    if table is not None and done < config.rounds:
        lessons = [demonstrated(policy, env, table, asking, config, seed, threads, quiet)]
    with Logger(out, total=total, title="hindsight", start=done * config.iterations, quiet=quiet) as log:
        for number in range(done, config.rounds):
            env.rng = np.random.default_rng([seed, number])
            if number or not lessons:
                if table is not None and config.matching:
                    told = demonstrated(policy, env, table, asking, config, seed + number, threads, quiet, generator)
                else:
                    told = relabel(play_on(policy, env, config, generator), env, config, seed + number)
                memory = [*memory, told]
                memory = memory[-config.memory :]
            seen, c, tokens, weight = (torch.cat(parts) for parts in zip(*lessons, *memory, strict=True))
            adapted.observe(c)
            for iteration in range(config.iterations):
                step = number * config.iterations + iteration
                for group in optimizer.param_groups:
                    group["lr"] = config.lr * (1 - 0.9 * step / total)
                ids = torch.multinomial(weight, config.batch, replacement=True, generator=generator)
                loss, told = adapted.loss(seen[ids], c[ids], tokens[ids].long(), config.label_smoothing)
                if not torch.isfinite(loss):
                    raise FloatingPointError(
                        f"the loss is {loss.item()} in round {number}; the last good state is {state.path}; "
                        "try a smaller --set hindsight.lr"
                    )
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                torch.nn.utils.clip_grad_norm_(adapted.trainable(), 1.0)
                optimizer.step()
                last = iteration == config.iterations - 1
                metrics = {f"hindsight/{name}": float(value) for name, value in told.items()} if step % 10 == 9 else {}
                if last:
                    score = evaluate()
                    metrics |= {"samples": float(len(seen))}
                    metrics |= {f"eval/{name}": value for name, value in score.summary().items()}
                    if score.merit > best:
                        best = score.merit
                        keep(score)
                if metrics:
                    log.write(step, metrics)
            state.save({"round": number + 1, "best": best}, memory=[list(part) for part in memory])


def play_on(policy: TokenPolicy, env: Env, config: HindsightConfig, generator: torch.Generator) -> Rollout:
    """`seconds` of the policy in every row."""
    steps = round(config.seconds * env.config.scene.control_hz)
    played = Rollout.empty(steps, env.rows, policy.state_dim, policy.tokens.tokens_per_step)
    obs = torch.as_tensor(env.reset())
    with torch.no_grad(), torch_threads(1):
        for t in range(steps):
            played.root[t] = env.sim.qpos[:, :7]
            action, taken = policy.draw(obs, generator)
            played.states[t], played.tokens[t] = obs[:, : policy.state_dim], taken["tokens"]
            step = env.step(action.numpy(force=True))
            played.terminated[t], played.cut[t, step.done] = step.terminated, True
            obs = torch.as_tensor(step.obs)
    env.episode_metrics()
    return played


def demonstrated(
    policy: TokenPolicy,
    env: Env,
    table: ReferenceTable,
    asking: Callable[[], Goal] | None,
    config: HindsightConfig,
    seed: int,
    threads: int,
    quiet: bool,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What `relabel` returns, of the frozen tokenizer on the table's clips: matched to the task, or as they are.

    generator: with one, the policy acts in half of the rows of half as many steps.
    """
    told = {"samples": config.samples, "rows": config.rows, "seed": seed, "threads": threads, "quiet": quiet}
    told |= {"env": config.env, "code_noise": config.code_noise}
    if not config.matching:
        return relabel(roam(policy.tokenizer, table, transitions=config.transitions, **told), env, config, seed)
    if generator is not None:
        told |= {"samples": config.samples // 2, "driver": policy.controller(generator)}
    goal = asking() if asking else cast(Goal, env.task)
    states, c, tokens = demonstrate(policy.tokenizer, table, goal, doomed=config.doomed, **told)
    return states, c, tokens, torch.ones(len(states))


def relabel(rolled: Rollout, env: Env, config: HindsightConfig, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """state (M, S), c (M, C), tokens (M, T) of the steps for which the task finds something that came true, and how
    often each is to be drawn (M,)."""
    terminated, cut = rolled.terminated, rolled.cut
    doomed = round(config.doomed * env.config.scene.control_hz)
    good = ~before_failure(terminated, cut, doomed)
    # The last step that each step may look ahead to: its path's last, or what came well before a fall.
    now = np.arange(len(cut))[:, None]
    ends = np.where(cut, now - np.where(terminated, doomed, 0), 2 * len(cut))
    last = np.where(cut, now, len(cut) - 1)
    last = np.minimum.accumulate(last[::-1], axis=0)[::-1]
    ends = np.minimum(np.take_along_axis(ends, last, 0), len(cut) - 1)
    heading = rotation.heading(rolled.root[..., 3:])
    c, told = env.task.hindsight(rolled.root[..., :2], heading, ends, np.random.default_rng(seed))
    keep = torch.as_tensor(good & told)
    if not keep.any():
        raise ValueError(
            f"in {cut.size} control steps nothing came true that the task could have asked for; "
            "play longer (hindsight.seconds, hindsight.samples), or look at the prior with `kinetok evaluate prior`"
        )
    fulfilled = torch.as_tensor(c)[keep]
    asked = torch.as_tensor(env.reset()[:, env.task.layout["task"]])
    return rolled.states[keep], fulfilled, rolled.tokens[keep], balance(fulfilled, asked, config)


def balance(fulfilled: Tensor, asked: Tensor, config: HindsightConfig) -> Tensor:
    """Weights (M,) with which the directions of fulfilled (M, C) are drawn as often as those of asked (K, C); the
    direction of a task observation is that of its last two numbers, the furthest ahead."""

    def sector(c: Tensor) -> Tensor:
        turn = torch.atan2(c[:, -1], c[:, -2]) / (2 * torch.pi) + 0.5
        return (turn * config.sectors).long() % config.sectors

    found = torch.bincount(sector(fulfilled), minlength=config.sectors).float() / len(fulfilled)
    wanted = torch.bincount(sector(asked), minlength=config.sectors).float() / len(asked)
    return (wanted / found.clamp_min(1e-6)).clamp(1 / config.boost, config.boost)[sector(fulfilled)]
