"""Full fine-tuning: a trainable copy of every parameter, to compare the adapters with.

Buffers, such as the statistics of the states, stay those of the base.
"""

import copy
from dataclasses import dataclass
from typing import Literal

from kinetok.adapters.inject import Condition, Model


@dataclass(frozen=True, kw_only=True)
class FullConfig:
    """kind: "full". hidden: width of the net behind the task token (see condition.py)."""

    kind: Literal["full"] = "full"
    hidden: int = 64


def bend(model: Model, config: FullConfig, condition: Condition | None) -> Model:
    """`model` over a copy of its parameters. It reads no condition."""
    bent = copy.deepcopy(model, {id(buffer): buffer for buffer in model.buffers()})
    return bent.requires_grad_(True)
