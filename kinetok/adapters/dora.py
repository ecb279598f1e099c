"""DoRA (Liu et al. 2024): magnitude and direction of a weight, learned apart. The weight-space variant.

    W = m * (W0 + (alpha / r) B A) / ||W0 + (alpha / r) B A||          y = W x + b              (eq. 5)

The norm is that of each output's row of weights, as in the authors' code and in peft (the paper writes
columns of the transpose), and counts as a constant in the gradient (sec. 4.3). m (d_out) starts at the norms
of W0, B at zero: at the start W is W0. GPC's CoLA borrows the magnitude but normalises the output: cola.py.
"""

from dataclasses import dataclass
from typing import Literal

import torch.nn.functional as F
from torch import Tensor, nn

from kinetok.adapters.inject import AdaptedLinear, Condition, Model, check_rank, replaced
from kinetok.adapters.lora import LoRALinear


@dataclass(frozen=True, kw_only=True)
class DoRAConfig:
    """kind: "dora". rank: r. alpha: alpha / r scales the update. targets: layers to adapt (see inject.py).
    hidden: width of the net behind the task token (see condition.py)."""

    kind: Literal["dora"] = "dora"
    rank: int = 16
    alpha: float = 32.0
    targets: tuple[str, ...] = ("blocks",)
    hidden: int = 64

    def __post_init__(self) -> None:
        check_rank("DoRA", self.rank, self.alpha, self.targets)


class DoRALinear(LoRALinear):
    """y = (m * V / ||V||) x + b with V = W0 + (alpha / r) B A, row by row."""

    def __init__(self, base: nn.Linear, *, rank: int, alpha: float):
        super().__init__(base, rank=rank, alpha=alpha)
        self.lora_magnitude_vector = nn.Parameter(base.weight.detach().norm(dim=1))

    def forward(self, x: Tensor) -> Tensor:
        """x (N, ..., d_in) -> (N, ..., d_out)."""
        return F.linear(x, self.weight(), self.base.bias)

    def weight(self) -> Tensor:
        """W, (d_out, d_in)."""
        direction = super().weight()
        return (self.lora_magnitude_vector / direction.detach().norm(dim=1))[:, None] * direction


def bend(model: Model, config: DoRAConfig, condition: Condition | None) -> Model:
    """`model` with DoRA at the targets. The layers read no condition."""

    def build(name: str, linear: nn.Linear) -> AdaptedLinear:
        return DoRALinear(linear, rank=config.rank, alpha=config.alpha)

    return replaced(model, config.targets, build)
