"""Codes to token ids and back, exactly.

    layout = TokenLayout.grouped(dim=40, levels=9, scalars=5)     # 8 tokens of 9**5 = 59,049
    tokens = layout.to_tokens(codes)                              # (N, 40) -> (N, 8)
    layout.to_codes(tokens)                                       # (N, 40) again

GPC sec. 6 packs every C consecutive scalars into one token; that belongs here, not to the net. A single code,
the levels of a residual quantizer and categorical channels are layouts as well: `scalars=1, levels=K`. Inside
a token the first scalar is the most significant digit.

The JSON of a layout is `to_dict(layout)` and `from_dict(TokenLayout, data)` of kinetok.config. Refuses
dimensions that do not divide, codes and tokens out of range, and vocabularies that int64 cannot hold. Knows
no tensors of motion and no model.
"""

from dataclasses import dataclass

import torch
from einops import rearrange
from torch import Tensor

from kinetok.tokenizers.quantizer import check_codes, check_width


@dataclass(frozen=True, kw_only=True)
class TokenLayout:
    """G groups of C scalars at L levels each: G tokens per step, of a vocabulary of L**C.

    groups: G. scalars: C, scalars per group. levels: L, values per scalar.
    """

    groups: int
    scalars: int
    levels: int

    def __post_init__(self) -> None:
        for name, least in (("groups", 1), ("scalars", 1), ("levels", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"TokenLayout needs {name} >= {least}, not {getattr(self, name)}")
        if self.vocabulary >= 2**63:
            raise ValueError(
                f"{self.scalars} scalars at {self.levels} levels make {self.levels}**{self.scalars} tokens, "
                "more than int64 holds; use fewer scalars per token"
            )

    @classmethod
    def grouped(cls, dim: int, levels: int, scalars: int) -> "TokenLayout":
        """Each `scalars` consecutive ones of `dim` scalars at `levels` levels make a token."""
        if dim < 1 or scalars < 1 or dim % scalars:
            divisors = [c for c in range(1, dim + 1) if dim % c == 0]
            raise ValueError(
                f"cannot group {dim} scalars by {scalars}: scalars per token must be a divisor of {dim}, "
                f"one of {divisors}"
            )
        return cls(groups=dim // scalars, scalars=scalars, levels=levels)

    @property
    def dim(self) -> int:
        """Scalars per step, D = G * C."""
        return self.groups * self.scalars

    @property
    def tokens_per_step(self) -> int:
        """S = G."""
        return self.groups

    @property
    def vocabulary(self) -> int:
        """V = L**C."""
        return self.levels**self.scalars

    def to_tokens(self, codes: Tensor) -> Tensor:
        """codes (..., D) int64 in 0..L-1 -> tokens (..., S) int64 in 0..V-1: sum_c code_c L^(C-1-c)."""
        check_width(codes, self.dim, "codes")
        check_codes(codes, self.levels, "codes")
        digits = rearrange(codes.long(), "... (g c) -> ... g c", c=self.scalars)
        return (digits * self._places(codes.device)).sum(-1)

    def to_codes(self, tokens: Tensor) -> Tensor:
        """tokens (..., S) int64 in 0..V-1 -> codes (..., D) int64 in 0..L-1."""
        check_width(tokens, self.groups, "tokens")
        check_codes(tokens, self.vocabulary, "tokens")
        digits = tokens.long()[..., None] // self._places(tokens.device) % self.levels
        return rearrange(digits, "... g c -> ... (g c)")

    def _places(self, device: torch.device) -> Tensor:
        """The place values (C,): L^(C-1), ..., L, 1."""
        return torch.tensor([self.levels**c for c in reversed(range(self.scalars))], device=device)
