"""Plain networks: an MLP, and the actor with its critic."""

from collections.abc import Iterable, Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from kinetok.config import pick
from kinetok.rl.normalize import RunningNorm

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "silu": nn.SiLU, "elu": nn.ELU, "gelu": nn.GELU}


def mlp(sizes: Sequence[int], activation: str, last_scale: float = 1.0) -> nn.Sequential:
    """Linear layers of the given sizes with activations between them; the last layer starts `last_scale` small."""
    layers: list[nn.Module] = []
    for index, (fan_in, fan_out) in enumerate(zip(sizes, sizes[1:], strict=False)):
        if index:
            layers.append(pick(ACTIVATIONS, activation, "activation")())
        layers.append(nn.Linear(fan_in, fan_out))
    with torch.no_grad():
        layers[-1].weight.mul_(last_scale)  # type: ignore[operator]
        layers[-1].bias.zero_()  # type: ignore[operator]
    return nn.Sequential(*layers)


class Actor(Protocol):
    """What PPO trains: observations (N, O) to mean actions (N, A), an auxiliary loss and metrics."""

    def act(self, obs: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]: ...
    def observe(self, obs: Tensor) -> None: ...
    def parameters(self) -> Iterable[nn.Parameter]: ...


class Critic(nn.Module):
    """State value (N,) of observations (N, O)."""

    def __init__(self, obs_size: int, widths: Sequence[int], activation: str = "silu"):
        super().__init__()
        self.norm = RunningNorm(obs_size)
        self.net = mlp([obs_size, *widths, 1], activation)

    def forward(self, obs: Tensor) -> Tensor:
        return self.net(self.norm(obs)).squeeze(-1)

    def observe(self, obs: Tensor) -> None:
        self.norm.observe(obs)
