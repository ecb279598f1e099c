"""Bending the prior to a task. The table of adapters is keyed by the `kind` of a config.

The adapted model is in adapted.py, the policy that reinforcement learning trains in policy.py.
"""

from kinetok.adapters import cola, dora, full, lora
from kinetok.adapters.cola import CoLAConfig
from kinetok.adapters.dora import DoRAConfig
from kinetok.adapters.full import FullConfig
from kinetok.adapters.lora import LoRAConfig

ADAPTERS = {
    "lora": (LoRAConfig, lora.bend),
    "dora": (DoRAConfig, dora.bend),
    "cola": (CoLAConfig, cola.bend),
    "full": (FullConfig, full.bend),
}

AdapterConfig = LoRAConfig | DoRAConfig | CoLAConfig | FullConfig

__all__ = ["ADAPTERS", "AdapterConfig", "CoLAConfig", "DoRAConfig", "FullConfig", "LoRAConfig"]
