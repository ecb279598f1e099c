"""Advantages: generalised advantage estimation with terminated and truncated kept apart."""

import torch
from torch import Tensor


def gae(
    rewards: Tensor, values: Tensor, next_values: Tensor, done: Tensor, gamma: float, lam: float
) -> tuple[Tensor, Tensor]:
    """Advantages and value targets (T, N); Schulman et al. 2016, eq. 16.

    rewards, values (T, N); next_values (T, N): V of the state each step led to, before any reset, and zero where
    that state was terminal; done (T, N) bool: the episode ended there, by failure or by time.

        delta_t = r_t + gamma * V'_t - V_t
        A_t     = delta_t + gamma * lam * (1 - done_t) * A_{t+1}
    """
    delta = rewards + gamma * next_values - values
    advantages = torch.empty_like(delta)
    running = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        running = delta[t] + gamma * lam * (~done[t]) * running
        advantages[t] = running
    return advantages, advantages + values
