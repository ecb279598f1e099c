"""Supervised fine-tuning: make the tokens of a few example clips more likely (GPC sec. 7.3).

    supervise(adapted, prior.tokenizer, clips, asked, SFTConfig(), out, save=save, seed=0)

The frozen tokenizer tracks the clips; what it chose, in the states it chose it in, is the data, and cross-entropy
moves the adapter. The clips ask for nothing: the task observation of each sample is drawn at random from `asked`,
so that the style comes whatever the task will say.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from kinetok.adapters.adapted import Adapted, fingerprint
from kinetok.checkpoint import flatten, load_state, save_state, unflatten
from kinetok.config import to_dict
from kinetok.gpt.data import record
from kinetok.logger import Logger
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.rl.training import refuse_changed
from kinetok.sim.env import EnvConfig
from kinetok.sim.tasks.tracking import ReferenceTable
from kinetok.tokenizers.tokenizer import MotionTokenizer


@dataclass(frozen=True, kw_only=True)
class SFTConfig:
    """samples: control steps recorded, in `rows` worlds; iterations of `batch` samples; lr, falling to a tenth;
    label_smoothing; code_noise, transitions: as in recording for a prior; eval_every: iterations."""

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


def supervise(
    adapted: Adapted,
    tokenizer: MotionTokenizer,
    clips: Sequence[Clip],
    asked: Tensor,
    config: SFTConfig,
    out: Path,
    *,
    save: Callable[[dict[str, float]], None],
    seed: int = 0,
    threads: int = 0,
    quiet: bool = False,
) -> dict[str, float]:
    """Adapt in place; returns the last metrics. asked (M, cond_dim): task observations to draw from. save(metrics) is
    called at every evaluation; `out` receives metrics.jsonl and a state from which a later call goes on."""
    library = ClipLibrary.of(clips)
    identity = {
        "stage": to_dict(config),
        "prior": fingerprint(adapted.base),
        "tokenizer": tokenizer.hash,
        "adapter": to_dict(adapted.config),
        "clips": list(library.names),
        "seed": seed,
    }
    path, step, metrics = out / "state.safetensors", 0, {}
    optimizer = torch.optim.Adam(adapted.trainable(), lr=config.lr, fused=True)
    generator = torch.Generator().manual_seed(seed)
    if path.exists():
        tensors, meta = load_state(path)
        refuse_changed(path, meta["identity"], identity, {"stage": SFTConfig})
        tree = unflatten(tensors, meta["tree"])
        adapted.load_adapter_state_(tree["adapted"])
        optimizer.load_state_dict(tree["optimizer"])
        generator.set_state(tree["generator"])
        step, metrics = meta["step"], tree["metrics"]
    if step >= config.iterations:
        return metrics
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
    learn, hold = data.split(config.held_out)
    conditioned = adapted.cond_dim > 0

    def loss(ids: Tensor, smoothing: float) -> tuple[Tensor, dict[str, Tensor]]:
        c = asked[torch.randint(len(asked), (len(ids),), generator=generator)] if conditioned else None
        return adapted.loss(data.states[ids], c, data.tokens[ids].long(), smoothing)

    with Logger(out, total=config.iterations, title="sft", start=step, quiet=quiet) as log:
        while step < config.iterations:
            for group in optimizer.param_groups:
                group["lr"] = config.lr * (1 - 0.9 * step / config.iterations)
            ids = learn[torch.randint(len(learn), (config.batch,), generator=generator)]
            value, told = loss(ids, config.label_smoothing)
            if not torch.isfinite(value):
                raise FloatingPointError(
                    f"the loss is {value.item()} at iteration {step}; the last good state is {path}; "
                    "try a smaller --set sft.lr"
                )
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            torch.nn.utils.clip_grad_norm_(adapted.trainable(), 1.0)
            optimizer.step()
            step += 1
            metrics = {f"sft/{name}": float(number) for name, number in told.items()}
            if step % config.eval_every == 0 or step == config.iterations:
                with torch.no_grad():
                    held = loss(hold[:4096], 0.0)[1]
                metrics |= {f"held_out/{name}": float(number) for name, number in held.items()}
                save(metrics)
                tree = {
                    "adapted": adapted.adapter_state(),
                    "optimizer": optimizer.state_dict(),
                    "generator": generator.get_state(),
                    "metrics": metrics,
                }
                tensors, skeleton = flatten(tree)
                save_state(path, tensors, {"tree": skeleton, "identity": identity, "step": step})
            log.write(step - 1, metrics)
    return metrics
