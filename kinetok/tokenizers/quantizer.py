"""What every bottleneck between a motion encoder and its decoder looks like, and the one that is none.

    quantizer = Continuous(dim=64)
    out = quantizer(z)                                   # Quantized(values, codes, loss, metrics)

A quantizer maps a latent z (N, dim_in) to what the decoder reads (N, dim_out), and to integer codes: scalar d
of a row is one of levels[d] values. `decode(encode(z))` is what the decoder read, exactly. A bottleneck
without codes (levels == ()) has no tokens: `encode` and `decode` refuse, and say what to use instead.
Grouping codes into tokens is the business of layout.py. Knows no motion, no simulator and no training loop.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn


@dataclass(frozen=True, kw_only=True)
class Quantized:
    """What a quantizer made of a latent.

    values: (N, dim_out) what the decoder reads; differentiable with respect to the latent.
    codes: (N, D) int64, scalar d in 0..levels[d]-1; (N, 0) from a continuous bottleneck.
    loss: scalar that the quantizer asks to be added to the training loss; zero where it needs none.
    metrics: detached scalars by name, for the log.
    """

    values: Tensor
    codes: Tensor
    loss: Tensor
    metrics: dict[str, Tensor]


class Quantizer(nn.Module, ABC):
    """A bottleneck.

    dim_in: width of the latent z.
    dim_out: width of the values that the decoder reads.
    levels: how many values code d can take, for each d; () where there are no codes.
    """

    dim_in: int
    dim_out: int
    levels: tuple[int, ...]

    @abstractmethod
    def forward(self, z: Tensor) -> Quantized:
        """z (N, dim_in) -> Quantized."""

    @abstractmethod
    def encode(self, z: Tensor) -> Tensor:
        """z (N, dim_in) -> codes (N, D) int64, without gradient."""

    @abstractmethod
    def decode(self, codes: Tensor) -> Tensor:
        """codes (N, D) int64 -> values (N, dim_out), the same that `forward` gave with these codes."""


@dataclass(frozen=True, kw_only=True)
class ContinuousConfig:
    """kind: "continuous". dim: width of the latent."""

    kind: Literal["continuous"] = "continuous"
    dim: int = 64


class Continuous(Quantizer):
    """No bottleneck: values = z. A motion tokenizer with it is a plain tracking policy (GPC's MLP)."""

    def __init__(self, dim: int):
        super().__init__()
        if dim < 1:
            raise ValueError(f"Continuous needs dim >= 1, not {dim}")
        self.dim_in = self.dim_out = dim
        self.levels = ()

    def forward(self, z: Tensor) -> Quantized:
        """z (N, dim) -> Quantized with values z and codes (N, 0)."""
        check_width(z, self.dim_in, "latent")
        codes = torch.empty(*z.shape[:-1], 0, dtype=torch.int64, device=z.device)
        return Quantized(values=z, codes=codes, loss=z.new_zeros(()), metrics={})

    def encode(self, z: Tensor) -> Tensor:
        raise ValueError(NO_TOKENS)

    def decode(self, codes: Tensor) -> Tensor:
        raise ValueError(NO_TOKENS)


NO_TOKENS = (
    "a continuous code has no tokens: use forward(z).values where a latent is enough, "
    'or train the tokenizer with a discrete quantizer such as kind="fsq"'
)


def check_width(x: Tensor, width: int, what: str) -> None:
    """Refuse a tensor whose last dimension is not `width`."""
    if x.ndim < 1 or x.shape[-1] != width:
        raise ValueError(f"{what} has shape {tuple(x.shape)}; its last dimension must be {width}")


def check_codes(codes: Tensor, levels: int, what: str) -> None:
    """Refuse integer codes of which some lie outside 0..levels-1."""
    if codes.is_floating_point() or codes.is_complex() or codes.dtype == torch.bool:
        raise ValueError(f"{what} must be integers, not {codes.dtype}; cast with .long() if they are whole numbers")
    if codes.numel() == 0:
        return
    low, high = (int(extreme) for extreme in codes.aminmax())
    if low < 0 or high >= levels:
        raise ValueError(f"{what} must lie in 0..{levels - 1}; found {low if low < 0 else high}")
