"""Hindsight fine-tuning: what the character did is what it was asked to do.

    hindsight(policy, env, HindsightConfig(), out, evaluate=evaluate, keep=keep, identity=identity, seed=0)

The policy plays the task; afterwards every step is relabelled with a task observation that the following seconds
fulfilled (a target it reached, a velocity it had, a path it took), and the adapter learns by cross-entropy to
choose the tokens that were chosen, given that observation. No reward and no critic: the prior's own variety is
the teacher. Steps before a fall are left out, so that what remains upright is learned. Repeated from its own
roll-outs, the policy reaches further from round to round.

Goal-conditioned supervised learning (Ghosh et al. 2021, "Learning to reach goals via iterated supervised
learning"), which GPC does not use: on two cores it brings in minutes what policy gradients over tokens need hours
for, and reinforcement learning goes on from there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from kinetok import rotation
from kinetok.adapters.rlft import TokenPolicy
from kinetok.checkpoint import flatten, load_state, save_state, unflatten
from kinetok.config import to_dict
from kinetok.gpt.data import before_failure
from kinetok.logger import Logger
from kinetok.rl.rollout import torch_threads
from kinetok.rl.training import Score, refuse_changed
from kinetok.sim.env import Env

S = TypeVar("S", bound=Score)


@dataclass(frozen=True, kw_only=True)
class HindsightConfig:
    """rounds: of playing and learning; rows, seconds: played in each; iterations of
    `batch` samples in each, at lr, falling to a tenth over all rounds; memory: rounds whose samples are kept; doomed:
    seconds before a fall that are left out; label_smoothing; sectors: directions of what was asked and of what was
    fulfilled are counted in so many, and samples drawn so that both are alike; boost: at most so much more often."""

    rounds: int = 4
    rows: int = 512
    seconds: float = 10.0
    iterations: int = 400
    batch: int = 512
    lr: float = 3e-3
    memory: int = 2
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
    seed: int = 0,
    quiet: bool = False,
) -> None:
    """Adapt in place. After each round `evaluate` measures, and `keep` is called with the best score so far. `out`
    receives metrics.jsonl and a state from which a later call with the same identity goes on after the last round."""
    adapted, best = policy.adapted, -1e9
    identity = identity | {"stage": to_dict(config)}
    path, done = out / "state.safetensors", 0
    optimizer = torch.optim.Adam(adapted.trainable(), lr=config.lr, fused=True)
    generator = torch.Generator().manual_seed(seed)
    memory: list[tuple[Tensor, ...]] = []
    if path.exists():
        tensors, meta = load_state(path)
        refuse_changed(path, meta["identity"], identity, {"stage": HindsightConfig})
        tree = unflatten(tensors, meta["tree"])
        adapted.load_adapter_state_(tree["adapted"])
        optimizer.load_state_dict(tree["optimizer"])
        generator.set_state(tree["generator"])
        memory, done, best = [tuple(part) for part in tree["memory"]], meta["round"], meta["best"]
    total = config.rounds * config.iterations
    with Logger(out, total=total, title="hindsight", start=done * config.iterations, quiet=quiet) as log:
        for number in range(done, config.rounds):
            env.rng = np.random.default_rng([seed, number])
            memory = [*memory, relabel(*play_on(policy, env, config, generator), env, config, seed + number)]
            memory = memory[-config.memory :]
            state, c, tokens, weight = (torch.cat(parts) for parts in zip(*memory, strict=True))
            adapted.observe(c)
            for iteration in range(config.iterations):
                step = number * config.iterations + iteration
                for group in optimizer.param_groups:
                    group["lr"] = config.lr * (1 - 0.9 * step / total)
                ids = torch.multinomial(weight, config.batch, replacement=True, generator=generator)
                loss, told = adapted.loss(state[ids], c[ids], tokens[ids].long(), config.label_smoothing)
                if not torch.isfinite(loss):
                    raise FloatingPointError(
                        f"the loss is {loss.item()} in round {number}; the last good state is {path}; "
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
                    metrics |= {"samples": float(len(state))}
                    metrics |= {f"eval/{name}": value for name, value in score.summary().items()}
                    if score.merit > best:
                        best = score.merit
                        keep(score)
                if metrics:
                    log.write(step, metrics)
            tree = {
                "adapted": adapted.adapter_state(),
                "optimizer": optimizer.state_dict(),
                "generator": generator.get_state(),
                "memory": [list(part) for part in memory],
            }
            tensors, skeleton = flatten(tree)
            meta = {"tree": skeleton, "identity": identity, "round": number + 1, "best": best}
            save_state(path, tensors, meta)


def play_on(
    policy: TokenPolicy, env: Env, config: HindsightConfig, generator: torch.Generator
) -> tuple[Tensor, Tensor, np.ndarray, np.ndarray, np.ndarray]:
    """`seconds` of the policy in every row: obs (T, N, O), tokens (T, N, S), root (T, N, 7) position and quaternion,
    terminated and done (T, N)."""
    steps = round(config.seconds * env.config.scene.control_hz)
    obs, seen, chosen = torch.from_numpy(env.reset()), [], []
    root = np.empty((steps, env.rows, 7), np.float32)
    terminated, done = np.zeros((2, steps, env.rows), bool)
    with torch.no_grad(), torch_threads(1):
        for t in range(steps):
            root[t] = env.sim.qpos[:, :7]
            action, taken = policy.draw(obs, generator)
            seen.append(obs)
            chosen.append(taken["tokens"].to(torch.int32))
            step = env.step(action.numpy())
            terminated[t], done[t, step.done] = step.terminated, True
            obs = torch.from_numpy(step.obs)
    env.episode_metrics()
    return torch.stack(seen), torch.stack(chosen), root, terminated, done


def relabel(
    obs: Tensor,
    tokens: Tensor,
    root: np.ndarray,
    terminated: np.ndarray,
    done: np.ndarray,
    env: Env,
    config: HindsightConfig,
    seed: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """state (M, S), c (M, C), tokens (M, T) of the steps for which the task finds something that came true, and how
    often each is to be drawn (M,)."""
    doomed = round(config.doomed * env.config.scene.control_hz)
    good = ~before_failure(terminated, done, doomed)
    # The last step that each step may look ahead to: its episode's last, or what came well before a fall.
    ends = np.where(done, np.arange(len(done))[:, None] - np.where(terminated, doomed, 0), 2 * len(done))
    last = np.where(done, np.arange(len(done))[:, None], len(done) - 1)
    last = np.minimum.accumulate(last[::-1], axis=0)[::-1]
    ends = np.minimum(np.take_along_axis(ends, last, 0), len(done) - 1)
    c, told = env.task.hindsight(root[..., :2], rotation.heading(root[..., 3:]), ends, np.random.default_rng(seed))
    keep = torch.from_numpy(good & told)
    if not keep.any():
        raise ValueError(
            f"in {config.seconds} s of {env.rows} rows nothing came true that the task could have asked for; "
            "play longer (hindsight.seconds), or look at the prior with `kinetok evaluate prior`"
        )
    fulfilled, asked = torch.from_numpy(c)[keep], obs[..., env.task.layout["task"]].flatten(0, 1)
    return obs[..., env.task.layout["state"]][keep], fulfilled, tokens[keep], balance(fulfilled, asked, config)


def balance(fulfilled: Tensor, asked: Tensor, config: HindsightConfig) -> Tensor:
    """Weights (M,) with which the directions of fulfilled (M, C) are drawn as often as those of asked (K, C); the
    direction of a task observation is that of its last two numbers, the furthest ahead."""

    def sector(c: Tensor) -> Tensor:
        turn = torch.atan2(c[:, -1], c[:, -2]) / (2 * torch.pi) + 0.5
        return (turn * config.sectors).long() % config.sectors

    found = torch.bincount(sector(fulfilled), minlength=config.sectors).float() / len(fulfilled)
    wanted = torch.bincount(sector(asked), minlength=config.sectors).float() / len(asked)
    return (wanted / found.clamp_min(1e-6)).clamp(1 / config.boost, config.boost)[sector(fulfilled)]
