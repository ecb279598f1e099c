"""Collect experience: T steps of N worlds under a policy.

    rollout = collect(world, policy, critic, obs, horizon=16, generator=g)

`World` is what `sim.Env` fits by shape. Torch runs on one thread here: the physics threads need the cores, and
one thread makes the states independent of the thread count. Networks and rollouts are on torch's default device,
worlds in NumPy: observations go over with `torch.as_tensor`, actions come back with `numpy(force=True)`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from kinetok.rl.nets import Critic
from kinetok.rl.policy import Policy


class World(Protocol):
    """rows worlds: step(action (N, A)) gives obs, reward, terminated, truncated, done ids and final_obs."""

    rows: int
    failed_simulations: int

    @property
    def obs_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    def reset(self, *, spread: bool = False) -> np.ndarray: ...
    def step(self, action: np.ndarray) -> Any: ...
    def episode_metrics(self) -> dict[str, float]: ...
    def state_dict(self) -> dict: ...
    def load_state_dict(self, state: dict) -> None: ...


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """(T, N, ...) tensors: obs; taken, what the policy drew; rewards; values of obs, next_values before resets (zero
    where terminal), done. last_obs (N, O) is where the next rollout begins."""

    obs: Tensor
    taken: dict[str, Tensor]
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


def seeded(seed: int) -> torch.Generator:
    """A generator of random numbers on torch's default device, where networks are."""
    return torch.Generator(torch.get_default_device()).manual_seed(seed)


@torch.no_grad()
def collect(
    world: World, policy: Policy, critic: Critic, obs: Tensor, *, horizon: int, generator: torch.Generator
) -> Rollout:
    """Step `world` from observations obs (N, O) for `horizon` steps."""
    n = world.rows
    all_obs = torch.empty(horizon + 1, n, world.obs_size)
    rewards, done = torch.empty(horizon, n), torch.zeros(horizon, n, dtype=torch.bool)
    terminal = torch.zeros(horizon, n, dtype=torch.bool)
    taken: list[dict[str, Tensor]] = []
    finals: list[tuple[int, np.ndarray, Tensor]] = []
    all_obs[0] = obs
    with torch_threads(1):
        for t in range(horizon):
            action, drawn = policy.draw(all_obs[t], generator)
            taken.append(drawn)
            step = world.step(action.numpy(force=True))
            all_obs[t + 1] = torch.as_tensor(step.obs)
            rewards[t] = torch.as_tensor(step.reward)
            terminal[t] = torch.as_tensor(step.terminated)
            done[t, step.done] = True
            if len(step.done):
                finals.append((t, step.done, torch.as_tensor(step.final_obs)))
    values = critic(all_obs.flatten(0, 1)).view(horizon + 1, n)
    next_values = values[1:].clone()
    if finals:
        ends = critic(torch.cat([final for _, _, final in finals])).split([len(ids) for _, ids, _ in finals])
        for (t, ids, _), end in zip(finals, ends, strict=True):
            next_values[t, ids] = end
    next_values[terminal] = 0
    return Rollout(
        obs=all_obs[:-1],
        taken={name: torch.stack([drawn[name] for drawn in taken]) for name in taken[0]},
        rewards=rewards,
        values=values[:-1],
        next_values=next_values,
        done=done,
        last_obs=all_obs[-1],
    )
