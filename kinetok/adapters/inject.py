"""Putting adapter layers into a model without touching it.

    names = match(("qkv", "head"), model)                      # ["blocks.0.qkv", ..., "head.out"]
    bent = replaced(model, ("blocks",), lambda name, linear: LoRALinear(linear, rank=8, alpha=16))

`bent` is a model of its own modules over the very parameters and buffers of `model`: nothing is copied, and
`model` still computes what it did. What depends on the task observation reaches the layers through a
`Condition` that they all hold, filled before each forward.

A target is the name of a linear layer ("blocks.0.qkv"), the end of one ("qkv"), or a module that holds some
("blocks", "head"). Refuses a target that names none. Knows no GPT: any module with linear layers will do.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import chain
from typing import TypeVar

from torch import Tensor, nn

from kinetok.config import ConfigError, nearest

Model = TypeVar("Model", bound=nn.Module)


class Condition:
    """What the layers of one adapted model read of the task, set for N rows.

    token: (N, width) added to the encoded state, or None where no layer reads it.
    film: gamma and beta, (N, R) each, by name of the layer that reads them; empty where none does.
    """

    def __init__(self) -> None:
        self.token: Tensor | None = None
        self.film: dict[str, tuple[Tensor, Tensor]] = {}

    def clear(self) -> None:
        """Forget it, with the graph behind it; layers that need it refuse to run until it is set again."""
        self.token, self.film = None, {}


class AdaptedLinear(nn.Module, ABC):
    """A layer in the place of the linear `base`, whose parameters it leaves alone."""

    base: nn.Linear

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """x (N, ..., d_in) -> (N, ..., d_out)."""

    @abstractmethod
    def merged(self) -> nn.Linear:
        """One linear layer that computes the same."""


def check_rank(kind: str, rank: int, alpha: float, targets: Sequence[str]) -> None:
    """Refuse what no low-rank adapter can be."""
    if rank < 1:
        raise ValueError(f"{kind} needs rank >= 1, not {rank}")
    if alpha <= 0:
        raise ValueError(f"{kind} needs alpha > 0, not {alpha}; alpha / rank scales what the adapter adds")
    if not targets:
        raise ValueError(f"{kind} needs at least one target, such as 'blocks'")


def match(targets: Sequence[str], model: nn.Module) -> list[str]:
    """Names of the linear layers of `model` that `targets` mean, in the order of the model."""
    names = [name for name, module in model.named_modules() if isinstance(module, nn.Linear)]
    found: set[str] = set()
    for target in targets:
        meant = {name for name in names if f".{name}.".endswith(f".{target}.") or name.startswith(f"{target}.")}
        if not meant:
            ends = list(dict.fromkeys(name.rpartition(".")[2] for name in names if not name[-1].isdigit()))
            rooms = [name for name, _ in model.named_children() if any(n.startswith(f"{name}.") for n in names)]
            said = f"one of {', '.join(rooms + ends)}, or a full name such as {names[0]!r}"
            raise ConfigError(f"no linear layer is called {target!r}; {said}{nearest(target, names + rooms + ends)}")
        found |= meant
    return [name for name in names if name in found]


def sharing_copy(model: Model) -> Model:
    """A copy of the modules of `model` over the same parameters and buffers."""
    return copy.deepcopy(model, {id(tensor): tensor for tensor in chain(model.parameters(), model.buffers())})


def replaced(model: Model, targets: Sequence[str], build: Callable[[str, nn.Linear], AdaptedLinear]) -> Model:
    """A sharing copy of `model` with build(name, linear) in the place of each linear that `targets` mean."""
    bent = sharing_copy(model)
    for name in match(targets, model):
        linear = bent.get_submodule(name)
        assert isinstance(linear, nn.Linear)
        bent.set_submodule(name, build(name, linear))
    return bent


def merged(bent: Model) -> Model:
    """A plain model, sharing nothing, that computes what `bent` does."""
    plain = copy.deepcopy(bent)
    for name, module in bent.named_modules():
        if isinstance(module, AdaptedLinear):
            plain.set_submodule(name, module.merged())
    return plain
