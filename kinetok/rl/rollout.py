"""Collect experience: T steps of N worlds under a policy with Gaussian noise.

    rollout = collect(world, actor, critic, horizon=16, log_std=-2.6, generator=g)

`World` is what `sim.Env` fits by shape. Torch runs on one thread here: the physics threads need the cores, and
one thread makes the states independent of the thread count.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from kinetok.rl.nets import Actor, Critic


class World(Protocol):
    """rows worlds: step(action (N, A)) gives obs, reward, terminated, truncated, done ids and final_obs."""

    rows: int

    @property
    def obs_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    def step(self, action: np.ndarray) -> Any: ...


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """(T, N, ...) tensors: obs, actions, means, rewards; values of obs, next_values before resets (zero where
    terminal), done. last_obs (N, O) is where the next rollout begins."""

    obs: Tensor
    actions: Tensor
    means: Tensor
    rewards: Tensor
    values: Tensor
    next_values: Tensor
    done: Tensor
    last_obs: Tensor


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run torch on `count` threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@torch.no_grad()
def collect(
    world: World, actor: Actor, critic: Critic, obs: Tensor, *, horizon: int, log_std: float, generator: torch.Generator
) -> Rollout:
    """Step `world` from observations obs (N, O) for `horizon` steps."""
    n, std = world.rows, float(np.exp(log_std))
    all_obs = torch.empty(horizon + 1, n, world.obs_size)
    actions, means = torch.empty(horizon, n, world.action_size), torch.empty(horizon, n, world.action_size)
    rewards, done = torch.empty(horizon, n), torch.zeros(horizon, n, dtype=torch.bool)
    terminal = torch.zeros(horizon, n, dtype=torch.bool)
    finals: list[tuple[int, np.ndarray, Tensor]] = []
    all_obs[0] = obs
    with torch_threads(1):
        for t in range(horizon):
            means[t] = actor.act(all_obs[t])[0]
            actions[t] = means[t] + std * torch.randn(means[t].shape, generator=generator)
            step = world.step(actions[t].numpy())
            all_obs[t + 1] = torch.from_numpy(step.obs)
            rewards[t] = torch.from_numpy(step.reward)
            terminal[t] = torch.from_numpy(step.terminated)
            done[t, step.done] = True
            if len(step.done):
                finals.append((t, step.done, torch.from_numpy(step.final_obs)))
    values = critic(all_obs.flatten(0, 1)).view(horizon + 1, n)
    next_values = values[1:].clone()
    if finals:
        ends = critic(torch.cat([final for _, _, final in finals])).split([len(ids) for _, ids, _ in finals])
        for (t, ids, _), end in zip(finals, ends, strict=True):
            next_values[t, ids] = end
    next_values[terminal] = 0
    return Rollout(
        obs=all_obs[:-1],
        actions=actions,
        means=means,
        rewards=rewards,
        values=values[:-1],
        next_values=next_values,
        done=done,
        last_obs=all_obs[-1],
    )
