"""Supervised fine-tuning: make the tokens of a few example clips more likely (GPC sec. 7.3).

    supervise(adapted, prior.tokenizer, clips, SFTConfig(), out, identity={}, save=save, seed=0)

The frozen tokenizer tracks the clips; what it chose, in the states it chose it in, is the data, and cross-entropy
moves the adapter. Whole worlds are held out; the best evaluation of them is kept.

The clips ask for nothing, so the nets that read the task observation stay at their start, where it changes nothing:
the style comes whatever the task says, exactly, and reinforcement learning finds them untouched.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kinetok.adapters.adapted import Adapted, AdapterPart
from kinetok.config import ConfigError, at_least, to_dict
from kinetok.gpt.data import TokenDataset, record
from kinetok.gpt.pretrain import EVAL_SAMPLES, held_out
from kinetok.logger import Logger
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.resume import State
from kinetok.rl.rollout import seeded
from kinetok.sim.env import EnvConfig
from kinetok.sim.tasks.tracking import ReferenceTable
from kinetok.tokenizers.tokenizer import MotionTokenizer


@dataclass(frozen=True, kw_only=True)
class SFTConfig:
    """samples: control steps recorded, in `rows` worlds; iterations of `batch` samples; lr, falling to a tenth;
    label_smoothing; code_noise, transitions, env: as in recording for a prior; held_out: share of worlds; eval_every:
    iterations."""

    samples: int = 50_000
    rows: int = 64
    iterations: int = 300
    batch: int = 512
    lr: float = 1e-3
    label_smoothing: float = 0.0
    code_noise: float = 0.05
    transitions: float = 0.3
    held_out: float = 0.1
    eval_every: int = 50
    env: EnvConfig = EnvConfig(reset_noise=0.02, push=0.3)

    def __post_init__(self) -> None:
        at_least(
            self,
            1,
            dict.fromkeys(("samples", "rows", "iterations", "batch", "eval_every"), "without, nothing is learned"),
        )
        if not 0 <= self.held_out < 1 or (self.held_out and self.rows < 2):
            raise ConfigError(f"held_out is a share of the {self.rows} rows that leaves some, not {self.held_out}")


def supervise(
    adapted: Adapted,
    tokenizer: MotionTokenizer,
    clips: Sequence[Clip],
    config: SFTConfig,
    out: Path,
    *,
    identity: dict[str, Any],
    save: Callable[[dict[str, float]], None],
    seed: int = 0,
    threads: int = 0,
    quiet: bool = False,
) -> dict[str, float]:
    """Adapt in place; returns the metrics of the best evaluation, whose adapter is not the last.

    identity: what else than the configuration and the clips a run must share with another to go on from it.
    save(metrics): called at each evaluation that is the best so far by held-out cross-entropy, or at every one where
    nothing is held out. `out` receives metrics.jsonl and a state from which a later call goes on, bit for bit.
    """
    library = ClipLibrary.of(clips)
    identity = {"sft": to_dict(config)} | library.identity() | identity
    step, best = 0, {"held_out/cross_entropy": math.inf}
    parameters = [p for p in adapted.gpt.parameters() if p.requires_grad]  # all but the nets that read c
    optimizer = torch.optim.Adam(parameters, lr=config.lr, fused=True)
    generator = seeded(seed)
    torch.manual_seed(seed)  # dropout's
    parts = {"optimizer": optimizer, "generator": generator, "dropout": torch.default_generator}
    state = State(out, {"adapter": AdapterPart(adapted), **parts}, identity=identity, kinds={"sft": SFTConfig})
    if before := state.restore():
        step, best = before[0]["step"], before[1]["best"]
    if step >= config.iterations:
        return best
    table = ReferenceTable(library, control_hz=tokenizer.config.scene.control_hz)
    data = record(
        tokenizer,
        table,
        samples=config.samples,
        rows=config.rows,
        seed=seed,
        threads=threads,
        env=config.env,
        transitions=config.transitions,
        code_noise=config.code_noise,
        quiet=quiet,
    )
    learn, hold = data.split(config.held_out, EVAL_SAMPLES)
    with Logger(out, total=config.iterations, title="sft", start=step, quiet=quiet) as log:
        while step < config.iterations:
            for group in optimizer.param_groups:
                group["lr"] = config.lr * (1 - 0.9 * step / config.iterations)
            ids = learn[torch.randint(len(learn), (config.batch,), generator=generator)]
            value, told = _loss(adapted.train(), data, ids, config.label_smoothing)
            if not torch.isfinite(value):
                raise FloatingPointError(
                    f"the loss is {value.item()} at iteration {step}; the last good state, if there is one yet, is "
                    f"{state.path}; try a smaller --set sft.lr"
                )
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()
            adapted.eval()
            step += 1
            metrics = {f"sft/{name}": float(number) for name, number in told.items()}
            evaluating = step % config.eval_every == 0 or step == config.iterations
            if evaluating:
                found = evaluate(adapted, data, hold)
                metrics |= found
                if not len(hold) or found["held_out/cross_entropy"] < best["held_out/cross_entropy"]:
                    best = found | {"iteration": float(step)}
                    save(best)
            log.write(step - 1, metrics)
            if evaluating:
                state.save({"step": step}, best=best)
    return best


def evaluate(adapted: Adapted, data: TokenDataset, ids: Tensor) -> dict[str, float]:
    """`held_out` of an adapter."""
    return held_out(lambda part: _loss(adapted, data, part)[1], ids)


def _loss(
    adapted: Adapted, data: TokenDataset, ids: Tensor, smoothing: float = 0.0
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss and metrics of the samples ids, with a task observation of zeros, which nothing reads yet."""
    nothing = torch.zeros(len(ids), adapted.cond_dim)
    return adapted.loss(data.states[ids], nothing, data.tokens[ids].long(), smoothing)
