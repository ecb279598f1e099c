"""Refine a prior by its own roll-outs: what stayed up is learned, what led to a fall is not.

    refine(gpt, prior, data, RefineConfig(), out, identity=identity, save=save, seed=0)

A prior imitates its tracker's choices, but it meets states of its own making, and there it falls. Each round lets
it move freely, under small pushes, leaves out what came before a fall, and goes on with cross-entropy on the rest,
half and half with the tracker's roll-outs, so that no motion is forgotten. This is filtered behaviour cloning, the
first step of expert iteration; GPC has nothing like it, its prior is made of 600 hours.

The best round by survival is kept, the first one being the prior as it came.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kinetok.gpt.controller import Prior, PriorController, roll
from kinetok.gpt.data import TokenDataset
from kinetok.gpt.model import GPT
from kinetok.logger import Logger
from kinetok.resume import State
from kinetok.rl.rollout import seeded, torch_threads
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.free import Free

DOWN, UP = 0.5, 0.62  # metres of the root: a fall goes from above UP to below DOWN


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """rounds: 0 for none; rows, seconds: played in each; top_p: of the play, wider than in use; doomed: seconds before
    a fall that are left out; patience: seconds granted to a start on the floor; iterations of `batch` samples, half of
    them the prior's own; memory: rounds whose samples are kept; ema: of the weights that play; state_noise:
    in standard deviations; episodes of `survive` seconds measure each round."""

    rounds: int = 6
    rows: int = 256
    seconds: float = 15.0
    top_p: float = 0.95
    doomed: float = 1.5
    patience: float = 5.0
    iterations: int = 300
    batch: int = 512
    lr: float = 3e-4
    memory: int = 2
    ema: float = 0.97
    state_noise: float = 0.01
    episodes: int = 96
    survive: float = 20.0
    env: EnvConfig = EnvConfig(push=0.3, push_seconds=3.0, reset_noise=0.02)


def refine(
    prior: Prior,
    data: TokenDataset,
    config: RefineConfig,
    out: Path,
    *,
    identity: dict[str, Any],
    save: Callable[[Prior, dict[str, float]], None],
    seed: int = 0,
    threads: int = 0,
    quiet: bool = False,
) -> None:
    """Play and learn for `config.rounds`.

    save(prior, metrics): called with the prior as it came, as round -1, and with every round that survives better than
    all before it. `out` receives metrics.jsonl and a state from which a later call goes on after the last round.
    """
    gpt = copy.deepcopy(prior.gpt).requires_grad_(True)
    average = copy.deepcopy(prior.gpt).eval().requires_grad_(False)
    playing = replace(prior, gpt=average)
    optimizer = torch.optim.AdamW(gpt.parameters(), lr=config.lr, betas=(0.9, 0.95), weight_decay=0.01, fused=True)
    generator = seeded(seed)
    parts = {"gpt": gpt, "average": average, "optimizer": optimizer, "generator": generator}
    state = State(out, parts, identity=identity, kinds={"stage": RefineConfig})
    done, best = 0, -1.0
    memory: list[tuple[Tensor, Tensor]] = []
    if before := state.restore():
        meta, kept = before
        memory = [(states, tokens) for states, tokens in kept["memory"]]
        done, best = meta["round"], meta["best"]
    if done == 0:
        best = survival(playing, config, seed, threads)
        save(playing, {"round": -1.0, "survival": best})
    total = config.rounds * config.iterations
    with Logger(out, total=total, title="refine", start=done * config.iterations, quiet=quiet) as log:
        for number in range(done, config.rounds):
            states, tokens, fell = play(playing, config, generator, seed=seed + number, threads=threads)
            memory = [*memory, (states, tokens)][-config.memory :]
            own = tuple(torch.cat(parts) for parts in zip(*memory, strict=True))
            if not len(own[0]):
                raise ValueError(
                    f"round {number} of refining: of {config.rows} roll-outs of {config.seconds:g} s none stayed up "
                    "long enough to learn from; see by `kinetok evaluate tracking` whether the tokenizer follows these "
                    "clips, or leave refining out: --set refine.rounds=0"
                )
            for iteration in range(config.iterations):
                loss = _learn(gpt, average, optimizer, data, own, config, generator)
                step = number * config.iterations + iteration
                if iteration == config.iterations - 1:
                    alive = survival(playing, config, seed, threads)
                    metrics = {"fell": fell, "kept": float(len(states)), "survival": alive, "loss": loss}
                    log.write(step, metrics)
                    if alive > best:
                        best = alive
                        save(playing, metrics | {"round": float(number)})
                elif step % 20 == 19:
                    log.write(step, {"loss": loss})
            state.save({"round": number + 1, "best": best}, memory=[list(part) for part in memory])


def survival(prior: Prior, config: RefineConfig, seed: int, threads: int) -> float:
    """Share of `episodes` from random starts whose root is up after `survive` seconds, unpushed, at top-p 0.9."""
    rng = np.random.default_rng([seed, 3])
    starts = rng.integers(len(prior.starts.qpos), size=config.episodes)
    recording = roll(
        prior, rows=config.episodes, seconds=config.survive, starts=starts, seed=seed + 1000, threads=threads
    )
    return float((~recording.blown_up & (recording.pos[-1, :, 0, 2] > DOWN)).mean())


def play(
    prior: Prior, config: RefineConfig, generator: torch.Generator, *, seed: int, threads: int
) -> tuple[Tensor, Tensor, float]:
    """states (M, S) and tokens (M, T) of what stayed up, and the share of rows that fell."""
    rows, steps = config.rows, round(config.seconds * prior.fps)
    rng = np.random.default_rng([seed, 4])
    starts = rng.integers(len(prior.starts.qpos), size=rows)
    task = Free(prior.character, prior.starts.qpos, prior.starts.qvel, rows=rows, starts=starts)
    world = replace(config.env, scene=prior.tokenizer.config.scene, episode_seconds=config.seconds + 1)
    env = Env(world, task, rows=rows, threads=threads, seed=seed)
    controller = PriorController(prior, top_p=config.top_p, generator=generator)
    states = torch.empty(steps, rows, env.obs_size)
    tokens = torch.empty(steps, rows, prior.gpt.config.tokens_per_step, dtype=torch.int32)
    height, broken = np.empty((steps, rows)), np.zeros(rows, bool)
    obs = env.reset()
    with torch.no_grad(), torch_threads(1):
        for t in range(steps):
            height[t] = np.where(broken, 0, env.sim.qpos[:, 2])
            states[t] = torch.as_tensor(obs)
            action, chosen = controller.act(states[t])
            tokens[t] = chosen.to(torch.int32)
            step = env.step(action.numpy(force=True))
            broken |= step.terminated
            obs = step.obs
    good = stayed_up(height, round(config.doomed * prior.fps), round(config.patience * prior.fps))
    kept = torch.as_tensor(good)
    fell = float(((height < DOWN) & np.maximum.accumulate(height > UP, axis=0)).any(0).mean())
    return states[kept], tokens[kept], fell


def stayed_up(height: np.ndarray, doomed: int, patience: int) -> np.ndarray:
    """Which of the root heights (T, N) to learn from: all but the last `doomed` steps before a row first falls, what
    comes after, and what a row does on the floor for longer than `patience` steps."""
    steps = np.arange(len(height))[:, None]
    risen = np.maximum.accumulate(height > UP, axis=0)
    fall = risen & (height < DOWN)
    first = np.where(fall.any(0), fall.argmax(0) - doomed, len(height))
    return (steps < first) & (risen | (steps < patience))


def _learn(
    gpt: GPT,
    average: GPT,
    optimizer: torch.optim.Optimizer,
    data: TokenDataset,
    own: tuple[Tensor, ...],
    config: RefineConfig,
    generator: torch.Generator,
) -> float:
    half = config.batch // 2
    before = torch.randint(len(data), (half,), generator=generator)
    now = torch.randint(len(own[0]), (half,), generator=generator)
    state = torch.cat([data.states[before], own[0][now]])
    tokens = torch.cat([data.tokens[before], own[1][now]]).long()
    noise = config.state_noise * torch.randn(state.shape, generator=generator)
    loss, _ = gpt.loss(state + noise * gpt.state_std, tokens)
    if not torch.isfinite(loss):
        raise FloatingPointError(f"the loss is {loss.item()}; the last good round is kept; try a smaller refine.lr")
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(gpt.parameters(), 1.0)
    optimizer.step()
    with torch.no_grad():
        for mean, weight in zip(average.parameters(), gpt.parameters(), strict=True):
            mean.lerp_(weight, 1 - config.ema)
    return float(loss.detach())
