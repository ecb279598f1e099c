"""The average of a policy's weights over its updates, which is steadier than any one of them (Polyak averaging).

    average = Average(actor.parameters(), factor=0.98)
    average.follow()                               # after every update
    with average.standing_in():                    # here the parameters are the average
        score = evaluate()

A PPO policy wanders about what it can do; its evaluations differ by more than it learns between them (docs/log.md, "The
average of a wandering policy"). Ours, not of a paper.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

AVERAGED = {"ema": "at 1 the average would never move"}  # config.below


class Average:
    """factor: how much of the average an update leaves, between 0 and 1; by the n-th (1 + n) / (4 + n) at most, which
    is the mean of all so far weighted by the square of their number. A part that a run saves and restores
    (resume.Part)."""

    def __init__(self, parameters: Iterable[nn.Parameter], factor: float):
        self.parameters, self.factor, self.count = list(parameters), factor, 0
        self.means = [parameter.detach().clone() for parameter in self.parameters]

    @torch.no_grad()
    def follow(self) -> None:
        """Take in what the parameters are now."""
        self.count += 1
        share = 1 - min(self.factor, (1 + self.count) / (4 + self.count))
        for mean, parameter in zip(self.means, self.parameters, strict=True):
            mean.lerp_(parameter, share)

    @contextmanager
    def standing_in(self) -> Iterator[None]:
        """The parameters are the average within, and themselves again afterwards."""
        own = [parameter.detach().clone() for parameter in self.parameters]
        self._put(self.means)
        try:
            yield
        finally:
            self._put(own)

    @torch.no_grad()
    def _put(self, tensors: list[Tensor]) -> None:
        for parameter, tensor in zip(self.parameters, tensors, strict=True):
            parameter.copy_(tensor)

    def state_dict(self) -> dict[str, Tensor]:
        means = {f"{index}": mean for index, mean in enumerate(self.means)}
        return means | {"count": torch.tensor(self.count)}

    def load_state_dict(self, state: dict[str, Tensor], /) -> None:
        self.count = int(state["count"])
        for index, mean in enumerate(self.means):
            mean.copy_(state[f"{index}"])
