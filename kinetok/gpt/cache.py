"""Keys and values of the positions decoded so far, for every layer of a GPT.

    cache = KVCache(layers=4, rows=64, heads=4, positions=8, head_dim=48)
    keys, values = cache.append(layer, k, v)         # (N, H, 1, E) -> all so far, (N, H, t + 1, E)
    cache.length += 1                                # after the last layer

Allocated once and reused: one control step fills it with its S decisions, `reset` empties it for the next.
Written in place, so no gradient passes through it. Knows nothing of states or tokens.
"""

import torch
from torch import Tensor


class KVCache:
    """keys, values: (layers, N, H, S, E), of which the first `length` positions are filled in every layer."""

    def __init__(
        self,
        *,
        layers: int,
        rows: int,
        heads: int,
        positions: int,
        head_dim: int,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ):
        shape = (layers, rows, heads, positions, head_dim)
        self.keys = torch.zeros(shape, dtype=dtype, device=device)
        self.values = torch.zeros(shape, dtype=dtype, device=device)
        self.length = 0

    @property
    def rows(self) -> int:
        """N."""
        return self.keys.shape[1]

    @property
    def positions(self) -> int:
        """S, the most positions it holds."""
        return self.keys.shape[3]

    def append(self, layer: int, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """Store key, value (N, H, 1, E) at position `length`; returns (N, H, length + 1, E) views of all."""
        at = self.length
        self.keys[layer, :, :, at] = key[:, :, 0]
        self.values[layer, :, :, at] = value[:, :, 0]
        return self.keys[layer, :, :, : at + 1], self.values[layer, :, :, : at + 1]

    def reset(self) -> None:
        """Forget every position; the memory stays."""
        self.length = 0
