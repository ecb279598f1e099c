"""LoRA (Hu et al. 2021): a low-rank update beside a frozen weight.

    y = W0 x + (alpha / r) B A x                                                                (sec. 4.1)

A (r, d_in) starts random, B (d_out, r) at zero: at the start the layer is its base. The tensors carry peft's
names, and a saved adapter without a task observation opens in peft.

Departure: A starts uniform as PyTorch's linears do (as in the authors' code and in peft), not Gaussian.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from kinetok.adapters.inject import AdaptedLinear, Condition, Model, check_rank, replaced


@dataclass(frozen=True, kw_only=True)
class LoRAConfig:
    """kind: "lora". rank: r. alpha: alpha / r scales the update. dropout: of what A reads, in supervised
    fine-tuning alone. targets: layers to adapt (see inject.py). hidden: width of the net behind the task token (see
    condition.py)."""

    kind: Literal["lora"] = "lora"
    rank: int = 16
    alpha: float = 32.0
    dropout: float = 0.0
    targets: tuple[str, ...] = ("blocks",)
    hidden: int = 64

    def __post_init__(self) -> None:
        check_rank("LoRA", self.rank, self.alpha, self.targets)
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"LoRA needs dropout in [0, 1), not {self.dropout}")


class LoRALinear(AdaptedLinear):
    """y = W0 x + (alpha / r) B A x."""

    def __init__(self, base: nn.Linear, *, rank: int, alpha: float, dropout: float = 0.0):
        super().__init__()
        self.base, self.scale = base, alpha / rank
        self.dropout = nn.Dropout(dropout)
        self.lora_A = nn.Linear(base.in_features, rank, bias=False)
        self.lora_B = nn.Linear(rank, base.out_features, bias=False)
        nn.init.zeros_(self.lora_B.weight)

    def forward(self, x: Tensor) -> Tensor:
        """x (N, ..., d_in) -> (N, ..., d_out)."""
        return torch.add(self.base(x), self.lora_B(self.lora_A(self.dropout(x))), alpha=self.scale)

    def weight(self) -> Tensor:
        """W0 + (alpha / r) B A, (d_out, d_in)."""
        return torch.addmm(self.base.weight, self.lora_B.weight, self.lora_A.weight, alpha=self.scale)

    def merged(self) -> nn.Linear:
        """The linear layer with the update in its weight."""
        return with_weight(self.base, self.weight())


def with_weight(linear: nn.Linear, weight: Tensor) -> nn.Linear:
    """A linear layer with this weight and a copy of the bias of `linear`."""
    out = nn.Linear(linear.in_features, linear.out_features, bias=linear.bias is not None)
    out.weight = nn.Parameter(weight.detach().clone())
    out.bias = None if linear.bias is None else nn.Parameter(linear.bias.detach().clone())
    return out


def bend(model: Model, config: LoRAConfig, condition: Condition | None) -> Model:
    """`model` with LoRA at the targets. The layers read no condition."""

    def build(name: str, linear: nn.Linear) -> AdaptedLinear:
        return LoRALinear(linear, rank=config.rank, alpha=config.alpha, dropout=config.dropout)

    return replaced(model, config.targets, build)
