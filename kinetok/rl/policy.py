"""What PPO improves: a policy that draws actions, and says later how probable they have become.

    policy = Gaussian(actor, log_std=-2.6)
    action, taken = policy.draw(obs, generator)        # for the world; for the update
    judged = policy.assess(obs, taken)                 # log_prob (N,), kl, loss to add, metrics

Rollout and update know no more of a policy than this, so that Gaussian PD targets and sequences of tokens are
trained by the same code.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor, nn

from kinetok.rl.nets import Actor


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """log_prob (N,) of what was taken, now; kl: divergence from the policy that took it, detached; loss: what the
    policy adds of its own (scalar); metrics: scalars by name."""

    log_prob: Tensor
    kl: Tensor
    loss: Tensor
    metrics: dict[str, Tensor] = field(default_factory=dict)


class Policy(Protocol):
    """draw gives the action (N, A) for the world and what `assess` needs of it: (N, ...) tensors, "log_prob" (N,)
    among them. observe merges observations into normalisers, between updates."""

    def draw(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]: ...
    def assess(self, obs: Tensor, taken: dict[str, Tensor]) -> Assessment: ...
    def observe(self, obs: Tensor) -> None: ...
    def parameters(self) -> Iterable[nn.Parameter]: ...


class Gaussian:
    """Noise of spread exp(log_std) around an actor's mean; the spread is set from outside, not learned.

    An actor's auxiliary loss (a quantizer's) is added as it is. `anchor` is a frozen actor, towards whose means the
    policy is pulled with strength `pull`, in units of the noise.
    """

    def __init__(self, actor: Actor, log_std: float, anchor: Actor | None = None, pull: float = 0.0):
        self.actor, self.log_std, self.anchor, self.pull = actor, log_std, anchor, pull

    def draw(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        mean = self.actor.act(obs)[0]
        action = mean + self._std * torch.randn(mean.shape, generator=generator)
        return action, {"action": action, "mean": mean, "log_prob": self._log_prob(action - mean)}

    def assess(self, obs: Tensor, taken: dict[str, Tensor]) -> Assessment:
        mean, loss, metrics = self.actor.act(obs)
        kl = -self._log_prob(mean.detach() - taken["mean"]).mean()
        if self.anchor is not None and self.pull:
            with torch.no_grad():
                target = self.anchor.act(obs)[0]
            distance = -self._log_prob(mean - target).mean()
            loss, metrics = loss + self.pull * distance, metrics | {"anchor": distance}
        return Assessment(log_prob=self._log_prob(taken["action"] - mean), kl=kl, loss=loss, metrics=metrics)

    def observe(self, obs: Tensor) -> None:
        self.actor.observe(obs)

    def parameters(self) -> Iterable[nn.Parameter]:
        return self.actor.parameters()

    @property
    def _std(self) -> Tensor:
        return torch.tensor(self.log_std).exp()

    def _log_prob(self, offset: Tensor) -> Tensor:
        """log N(offset; 0, std) (N,) up to its constant."""
        return -0.5 * self._std**-2 * offset.pow(2).sum(-1)
