"""Made models for tests: a tokenizer that holds a pose, never trained, and a prior over its tokens."""

from pathlib import Path

import numpy as np
import torch

from kinetok.gpt.controller import Prior, noted_path
from kinetok.gpt.data import draw_starts
from kinetok.gpt.model import GPT, GPTConfig
from kinetok.motion.clip import Clip
from kinetok.presets import FIT
from kinetok.sim.tasks.tracking import ReferenceTable
from kinetok.tokenizers.fit import new_tokenizer
from kinetok.tokenizers.tokenizer import MotionTokenizer


def make_clips(table: ReferenceTable) -> list[Clip]:
    """The clips a table was made of, as far as its frames tell."""
    return [
        Clip(
            name=name,
            character="humanoid",
            fps=float(table.control_hz),
            qpos=table.qpos[first : first + cycle + 1],
            loop=bool(last - first > cycle),
        )
        for name, first, last, cycle in zip(table.names, table.first, table.last, table.cycle, strict=True)
    ]


def make_tokenizer(path: Path, table: ReferenceTable, seed: int = 0) -> MotionTokenizer:
    """An untrained tokenizer of 2 tokens of 125, saved at `path` and loaded from it."""
    tokenizer = new_tokenizer(FIT["tiny"]().tokenizer, table, seed)
    tokenizer.save_pretrained(path, "made for a test")
    return MotionTokenizer.from_pretrained(path)


def make_prior(path: Path, table: ReferenceTable) -> Prior:
    """An untrained prior at path / "prior" with its tokenizer at path / "tokenizer"."""
    tokenizer = make_tokenizer(path / "tokenizer", table)
    torch.manual_seed(0)
    layout = tokenizer.layout
    shape = GPTConfig(
        state_dim=tokenizer.sizes["state"],
        tokens_per_step=layout.tokens_per_step,
        scalars=layout.scalars,
        levels=layout.levels,
        width=16,
        layers=1,
        heads=2,
    )
    Prior(
        gpt=GPT(shape),
        tokenizer=tokenizer,
        tokenizer_path=noted_path(path / "tokenizer", path / "prior"),
        clips=table.names,
        starts=draw_starts(table, 8, np.random.default_rng(0)),
    ).save_pretrained(path / "prior", "made for a test")
    return Prior.from_pretrained(path / "prior")
