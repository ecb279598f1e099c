"""A world and an actor small enough to know by heart; both fit the Protocols of kinetok.rl by shape."""

from types import SimpleNamespace

import numpy as np
import torch
from torch import nn

from kinetok.rl.normalize import RunningNorm


class Aim:
    """Rows that are rewarded for an action near twice their observation. An episode lasts `length` steps; rows in
    `mortal` terminate there, the others are truncated. Observation column 1 is the age."""

    obs_size, action_size = 2, 1

    def __init__(self, rows: int, length: int = 4, mortal: tuple[int, ...] = (), seed: int = 0):
        self.rows, self.length = rows, length
        self.mortal = np.isin(np.arange(rows), mortal)
        self.rng, self.age, self.taken = np.random.default_rng(seed), np.zeros(rows), []
        self.obs = self.fresh(np.arange(rows))

    def fresh(self, ids: np.ndarray) -> np.ndarray:
        self.age[ids] = 0
        return np.stack([self.rng.uniform(-1, 1, len(ids)), 0 * ids], axis=1).astype(np.float32)

    def step(self, action: np.ndarray) -> SimpleNamespace:
        self.taken.append(action.copy())
        reward = -((action[:, 0] - 2 * self.obs[:, 0]) ** 2).astype(np.float32)
        self.age += 1
        self.obs = np.stack([self.obs[:, 0], self.age], axis=1).astype(np.float32)
        over = self.age >= self.length
        done, final = np.flatnonzero(over), self.obs[over]
        self.obs[done] = self.fresh(done)
        return SimpleNamespace(obs=self.obs.copy(), reward=reward, terminated=over & self.mortal,
                               truncated=over & ~self.mortal, done=done, final_obs=final)  # fmt: skip


class Line(nn.Module):
    """mean action = w . obs + b, with an auxiliary loss of `weight` * w^2."""

    def __init__(self, weight: float = 0.0):
        super().__init__()
        self.line, self.weight, self.norm = nn.Linear(2, 1), weight, RunningNorm(2)
        nn.init.zeros_(self.line.weight)
        nn.init.zeros_(self.line.bias)

    def act(self, obs):
        loss = self.weight * self.line.weight.pow(2).sum()
        return self.line(obs), loss, {"weight": self.line.weight.detach().abs().sum()}

    def observe(self, obs: torch.Tensor) -> None:
        self.norm.observe(obs)
