"""Running mean and variance of observations, part of the model that was trained with them."""

import torch
from torch import Tensor, nn

from kinetok.rl import ranks


class RunningNorm(nn.Module):
    """Normalises x (..., D) to zero mean and unit variance, clipped to +-`clip`.

    The statistics move only in `observe`, between updates, so that the log-probabilities of a rollout stay those
    of the policy that acted.
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, size: int, clip: float = 6.0):
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        return ((x - self.mean) * (self.var + 1e-4).rsqrt()).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def observe(self, x: Tensor) -> None:
        """Merge a batch (..., D), and those of the other ranks, into the statistics (Chan et al. 1979)."""
        x = x.reshape(-1, x.shape[-1])
        if not torch.isfinite(x).all():
            raise FloatingPointError("observations hold a value that is not finite")
        new = float(len(x) * ranks.size())
        total = float(self.count) + new
        own, var = x.mean(0), x.var(0, unbiased=False)
        mean = own.clone()
        ranks.average_((mean,))
        var = var + (own - mean) ** 2
        ranks.average_((var,))
        delta = mean - self.mean
        share = new / total
        self.var.copy_(self.var * (1 - share) + var * share + delta**2 * share * (1 - share))
        self.mean += delta * share
        self.count.fill_(min(total, 1e7))
