"""Finite scalar quantization: each scalar of the latent is bounded and rounded to one of L levels.

    fsq = FSQ(dim=40, levels=9)
    out = fsq(z)                        # values in [-1, 1], codes in 0..8
    fsq.decode(out.codes)               # equals out.values, bit for bit

Sources: GPC (generative pretrained controllers) sec. 5, eq. 4; Mentzer et al. 2023, "Finite Scalar
Quantization: VQ-VAE Made Simple", sec. 3 and app. A.1. No codebook, no auxiliary loss: the only gradient is
the straight-through one, that of the bounded value.

Departures
- GPC eq. 4 is written for odd L; at even L its formula has L + 1 levels. Here bound="gpc" takes the half-step
  offset of Mentzer et al. for even L, so that exactly L levels occur: levels -L/2 .. L/2 - 1.
- The decoder reads level / floor(L/2), in [-1, 1], not the integer level, so that its input has the same
  scale at every L (as in vector-quantize-pytorch).
- bound="mentzer" widens the range by 1 + 1e-3 as vector-quantize-pytorch does; the paper's listing shrinks it
  by 1 - 1e-3, and shifts by tan where atanh is meant.

Refuses: fewer than 2 levels, and codes outside 0..L-1. Knows nothing of tokens: layout.py groups the codes.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from kinetok.config import pick
from kinetok.tokenizers.quantizer import Quantized, Quantizer, check_codes, check_width

Bound = Literal["gpc", "mentzer"]

# Above this the widened range of bound="mentzer" would reach one level too many.
MOST_LEVELS = 1000


@dataclass(frozen=True, kw_only=True)
class FSQConfig:
    """kind: "fsq". dim: scalars per latent. levels: L, values per scalar. bound: see FSQ. unit: the latent is brought
    to a root mean square of one before it is bounded."""

    kind: Literal["fsq"] = "fsq"
    dim: int = 24
    levels: int = 9
    bound: Bound = "gpc"
    unit: bool = False


class FSQ(Quantizer):
    """round(bound(z)), straight-through. With h = floor(L/2):

    bound="gpc"       odd L:   h tanh(z)  (GPC eq. 4)
                      even L:  (L-1)/2 tanh(z) - 1/2
    bound="mentzer"   w tanh(z + s) - o, where w = (L-1)(1 + 1e-3)/2, o = 1/2 for even L else 0, and
                      s = atanh(o / w), so that z = 0 is bounded to 0 at even L too

    level = round(bound(z)) in -h .. L-1-h;  value = level / h;  code = level + h in 0..L-1.

    unit=True puts z / rms(z) in the place of z (ours). Reinforcement learning from nothing drives the encoder to where
    tanh is flat: after 0.4 million samples 99 % of the scalars lie at an outermost level, where hardly a gradient
    passes (docs/log.md). Of unit size they cannot all go there.
    """

    def __init__(self, dim: int, levels: int = 9, bound: Bound = "gpc", unit: bool = False):
        super().__init__()
        self._unit = unit
        if dim < 1:
            raise ValueError(f"FSQ needs dim >= 1, not {dim}")
        if not 2 <= levels <= MOST_LEVELS:
            raise ValueError(f"FSQ needs levels in 2..{MOST_LEVELS}, not {levels}")
        self.dim_in = self.dim_out = dim
        self.levels = (levels,) * dim
        self._half = levels // 2
        self._offset = 0.0 if levels % 2 else 0.5
        widths = {"gpc": (levels - 1) / 2, "mentzer": (levels - 1) * (1 + 1e-3) / 2}
        self._width = pick(widths, bound, "FSQ bound")
        self._shift = math.atanh(self._offset / self._width) if bound == "mentzer" else 0.0

    def bound(self, z: Tensor) -> Tensor:
        """z (N, dim) -> the bounded value before rounding (N, dim), in units of levels."""
        if self._unit:
            z = z * torch.rsqrt(z.pow(2).mean(-1, keepdim=True) + 1e-6)
        return self._width * torch.tanh(z + self._shift) - self._offset

    def forward(self, z: Tensor) -> Quantized:
        """z (N, dim) -> Quantized. Metrics: `saturation`, the share of scalars at an outermost level, and
        `rounding`, the mean distance to the rounded value in levels (0.25 when spread evenly).
        """
        check_width(z, self.dim_in, "latent")
        bounded = self.bound(z)
        levels = bounded.detach().round()
        # Written so that the value is the rounded one exactly: bounded - bounded.detach() is zero.
        values = (levels + (bounded - bounded.detach())) / self._half
        codes = levels.long() + self._half
        metrics = {
            "saturation": ((codes == 0) | (codes == self.levels[0] - 1)).float().mean(),
            "rounding": (bounded.detach() - levels).abs().mean(),
        }
        return Quantized(values=values, codes=codes, loss=z.new_zeros(()), metrics=metrics)

    @torch.no_grad()
    def encode(self, z: Tensor) -> Tensor:
        """z (N, dim) -> codes (N, dim) int64."""
        check_width(z, self.dim_in, "latent")
        return self.bound(z).round().long() + self._half

    def decode(self, codes: Tensor) -> Tensor:
        """codes (N, dim) int64 -> values (N, dim) in [-1, 1], in torch's default dtype."""
        check_width(codes, self.dim_in, "codes")
        check_codes(codes, self.levels[0], "FSQ codes")
        return (codes - self._half).to(torch.get_default_dtype()) / self._half
