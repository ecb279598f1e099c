"""CoLA, conditional low-rank adaptation (GPC eq. 7): what a layer adds depends on the task observation c.

    y = W0 x + (alpha / r) m * u / rms(u),     u = B (gamma(c) * A x + beta(c)),     rms(u) = ||u|| / sqrt(d_out)

The activation-space variant: the magnitude m (d_out) is decoupled from the direction of the low-rank output,
position by position. (DoRA, dora.py, does this to the weight.) gamma and beta come from a small net of c, which
sees c once per control step, not once per token. Without a task observation gamma = 1 and beta = 0.

At the start gamma = 1, beta = 0, B is random as A is, and m = 0: the layer is its base.

Departures from GPC sec. 7.1 and app. D.3
- The paper starts B at zero, where eq. 7 is 0/0. With a small epsilon under the norm the first step of Adam takes
  the update from nothing to length m, whatever the learning rate. Measured on the packaged prior (supervised on
  made states, one seed, rank 16, lr 1e-3, 120 steps): with m = 0.1 the first step moved a control step's
  distribution by 39 nats of KL, and the loss still lay above its start at steps 20 to 30. An epsilon as large as u
  avoids that, but then the norm does nothing: the run was LoRA's to three digits. With m = 0 no step moved more
  than 0.02 nats (LoRA: 0.065); A, B, gamma and beta learn from the second step on. It wants a larger learning
  rate: at 3e-3 it ended where LoRA did at 1e-3.
- ||u|| is replaced by rms(u), a factor sqrt(d_out) that m could absorb: a step of Adam on m then moves every output
  by about the learning rate times alpha / r, at any width. With ||u|| learning took three to four times the steps.
- alpha / r would cancel inside the norm; it multiplies m. The paper does not say where it enters.
- The paper's gamma and beta come from one MLP per layer; here from one hidden layer for all, with outputs per layer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kinetok.adapters.inject import AdaptedLinear, Condition, Model, check_rank, replaced

EPSILON = 1e-8  # under the root, in units of u squared: only an input of zeros comes near it
UNMERGEABLE = (
    "a CoLA layer cannot be merged into one weight: the norm in eq. 7 makes it nonlinear in its input; "
    'keep the adapter, or train kind="lora" or "dora"'
)


@dataclass(frozen=True, kw_only=True)
class CoLAConfig:
    """kind: "cola". rank: r, the paper's. alpha: alpha / r scales the update, the paper's. targets: layers to adapt
    (see inject.py). hidden: width of the net behind gamma and beta, and of the one behind the task token.
    task_token: let c also enter as a task token (see condition.py)."""

    kind: Literal["cola"] = "cola"
    rank: int = 64
    alpha: float = 128.0
    targets: tuple[str, ...] = ("blocks",)
    hidden: int = 64
    task_token: bool = True

    def __post_init__(self) -> None:
        check_rank("CoLA", self.rank, self.alpha, self.targets)


class CoLALinear(AdaptedLinear):
    """y = W0 x + (alpha / r) m * u / rms(u). name: under which `condition.film` holds its gamma and beta;
    without a condition gamma = 1 and beta = 0.

    The norm of u is taken in rank space and m is applied to B, so that nothing but the two products is as wide as
    d_out: about a quarter faster to train on a CPU.
    """

    def __init__(self, base: nn.Linear, *, rank: int, alpha: float, condition: Condition | None, name: str):
        super().__init__()
        self.base, self.scale, self.condition, self.name = base, alpha / rank, condition, name
        self.lora_A = nn.Linear(base.in_features, rank, bias=False)
        self.lora_B = nn.Linear(rank, base.out_features, bias=False)
        self.magnitude = nn.Parameter(torch.zeros(base.out_features))

    def forward(self, x: Tensor) -> Tensor:
        """x (N, ..., d_in) -> (N, ..., d_out)."""
        a, b = self.lora_A.weight, self.lora_B.weight
        z = self._modulated(F.linear(x, a))
        square = (F.linear(z, b.mT @ b) * z).sum(-1, keepdim=True).clamp_min(0.0)  # ||B z||^2 = z (B^T B) z
        inverse = torch.rsqrt(square / len(b) + EPSILON)
        scaled = (self.scale * self.magnitude)[:, None] * b
        return self.base(x) + F.linear(z * inverse, scaled)  # eq. 7

    def _modulated(self, low: Tensor) -> Tensor:
        """gamma(c) * low + beta(c), (N, ..., R)."""
        if self.condition is None:
            return low
        if self.name not in self.condition.film:
            raise ValueError("the condition is not set; run the layer through its adapted model, with c")
        gamma, beta = (film.view(len(film), *[1] * (low.ndim - 2), -1) for film in self.condition.film[self.name])
        return torch.addcmul(beta, gamma, low)

    def merged(self) -> nn.Linear:
        """Refuses: there is none."""
        raise ValueError(UNMERGEABLE)


class Film(nn.Module):
    """gamma and beta (Perez et al. 2018) of every adapted layer: c (N, C) -> one hidden layer -> (N, R) each."""

    def __init__(self, cond_dim: int, hidden: int, rank: int, names: Sequence[str]):
        super().__init__()
        self.names, self.rank = tuple(names), rank
        self.trunk = nn.Linear(cond_dim, hidden)
        self.out = nn.Linear(hidden, len(names) * 2 * rank)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, c: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """c (N, C), normalised -> (gamma, beta) by name of the layer."""
        parts = self.out(F.gelu(self.trunk(c))).split(self.rank, dim=-1)
        return {name: (1.0 + parts[2 * i], parts[2 * i + 1]) for i, name in enumerate(self.names)}


def bend(model: Model, config: CoLAConfig, condition: Condition | None) -> Model:
    """`model` with CoLA at the targets, whose layers read `condition.film`."""

    def build(name: str, linear: nn.Linear) -> AdaptedLinear:
        return CoLALinear(linear, rank=config.rank, alpha=config.alpha, condition=condition, name=name)

    return replaced(model, config.targets, build)
