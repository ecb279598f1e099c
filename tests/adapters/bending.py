"""Tiny GPTs and adapters for tests."""

from dataclasses import replace

import torch

from kinetok.adapters import CoLAConfig, DoRAConfig, FullConfig, LoRAConfig
from kinetok.adapters.adapted import Adapted
from kinetok.gpt import GPT, GPTConfig

TINY = GPTConfig(state_dim=7, tokens_per_step=4, scalars=2, levels=3, width=16, layers=2, heads=2, head_width=12)
HEADS = ["softmax", "factorised"]
KINDS = {
    "lora": LoRAConfig(rank=3, alpha=5.0, hidden=8),
    "dora": DoRAConfig(rank=3, alpha=5.0, hidden=8),
    "cola": CoLAConfig(rank=3, alpha=5.0, hidden=8),
    "cola, film only": CoLAConfig(rank=3, alpha=5.0, hidden=8, task_token=False),
    "cola, everywhere": CoLAConfig(rank=3, alpha=5.0, hidden=8, targets=("blocks", "state_encoder", "head")),
    "full": FullConfig(hidden=8),
}


def build(head: str = "softmax", seed: int = 0, scale: float = 8.0) -> GPT:
    """A tiny model with weights `scale` times too large, so that every input matters."""
    torch.manual_seed(seed)
    model = GPT(replace(TINY, head=head))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(scale) if parameter.ndim > 1 else None
    return model.eval()


def bend(kind: str, head: str = "softmax", cond_dim: int = 2, moved: bool = False) -> Adapted:
    """An adapted tiny model; moved: every parameter of the adapter a random step away from its start."""
    adapted = Adapted(build(head), KINDS[kind], cond_dim)
    return move(adapted) if moved else adapted


@torch.no_grad()
def move(adapted: Adapted) -> Adapted:
    generator = torch.Generator().manual_seed(1)
    for parameter in adapted.trainable():
        parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator))
    adapted.observe(torch.randn(50, adapted.cond_dim, generator=generator)) if adapted.cond_dim else None
    return adapted


def batch(rows: int = 5, cond_dim: int = 2) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """state (N, 7), c (N, cond_dim), tokens (N, 4)."""
    generator = torch.Generator().manual_seed(3)
    state, tokens = torch.randn(rows, 7, generator=generator), torch.randint(9, (rows, 4), generator=generator)
    return state, torch.randn(rows, cond_dim, generator=generator), tokens
