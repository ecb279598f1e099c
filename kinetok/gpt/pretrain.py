"""Pre-train the prior: record what the frozen tokenizer says, then learn to say it (GPC sec. 6, app. C.1).

    prior = pretrain(tokenizer, clips, PretrainConfig(), Path("runs/prior"), tokenizer_path="runs/walk", seed=0)

`out` receives tokens.safetensors (the recorded data, made once), metrics.jsonl, the artifact and
state.safetensors: a later call with the same configuration goes on bit for bit where that state was written; a
changed one is refused, saying what changed. The artifact holds the averaged weights of the evaluation with the
lowest held-out cross-entropy; whole worlds are held out.

Departures from GPC
- EMA factor 0.999 per step (warmed up), where the paper has 0.9 at an update cadence it does not give.
- Gaussian noise on the normalised states: the prior meets states its own tokens led to, not the tracker's.
- AdamW with a cosine schedule; the paper does not name its optimiser.
"""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from kinetok.checkpoint import Artifact, CheckpointError, load_artifact, refuse_foreign
from kinetok.config import ConfigError, at_least, diff, from_dict, to_dict
from kinetok.gpt.controller import Prior, gpt_weights, noted_path
from kinetok.gpt.data import TokenDataset, record
from kinetok.gpt.model import GPT, GPTConfig
from kinetok.gpt.refine import RefineConfig, refine
from kinetok.logger import Logger
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.resume import State
from kinetok.rl import ranks
from kinetok.rl.rollout import seeded, torch_threads
from kinetok.sim.env import EnvConfig
from kinetok.sim.tasks.roaming import REACH
from kinetok.sim.tasks.tracking import ReferenceTable
from kinetok.tokenizers.layout import TokenLayout
from kinetok.tokenizers.tokenizer import MotionTokenizer, require_character

THREADS = 2  # of torch, where none are asked for: one number everywhere keeps results the same everywhere
EVAL_SAMPLES = 8192
LOG_EVERY = 20
# Settings that decide the recorded data.
RECORDING = ("samples", "rows", "transitions", "code_noise", "reach_at_end", "wander", "env")


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """width, layers, heads, head, head_width, dropout: of the GPT (see GPTConfig).

    samples: control steps to record. rows: worlds that record. transitions: changes of clip per second. code_noise:
    share of scalars whose executed code is one level off. reach_at_end: how far, in metres of roaming.likeness, a
    motion may jump where its clip ends and nothing nearer follows. wander: seconds between changes of where half of
    the rows want to go, 0 for none. env: pushes, noise and episodes of the recording.
    iterations of batch samples; lr falls by a cosine to lr_end after warmup iterations. weight_decay: of matrices.
    label_smoothing. ema: factor of the averaged weights. state_noise: standard deviations. held_out: share of worlds.
    eval_every: iterations between evaluations, saves included.
    start: prior of the same shape, by directory or packaged name, that training begins as, state statistics included:
    after a change of its tokenizer or its clips, when skills that bend it are to go on (`rebase` of adapters.finetune).
    """

    width: int = 192
    layers: int = 4
    heads: int = 4
    head: Literal["softmax", "factorised"] = "softmax"
    head_width: int = 128
    dropout: float = 0.0
    samples: int = 400_000
    rows: int = 256
    transitions: float = 0.3
    code_noise: float = 0.0
    reach_at_end: float = REACH
    wander: float = 0.0
    env: EnvConfig = EnvConfig(reset_noise=0.02, push=0.5)
    iterations: int = 3000
    batch: int = 512
    lr: float = 1e-3
    lr_end: float = 1e-5
    warmup: int = 100
    weight_decay: float = 0.01
    label_smoothing: float = 0.02
    ema: float = 0.999
    state_noise: float = 0.02
    held_out: float = 0.05
    eval_every: int = 500
    refine: RefineConfig = RefineConfig(rounds=0)
    start: str = ""

    def __post_init__(self) -> None:
        counts = ("samples", "rows", "iterations", "batch", "eval_every")
        at_least(self, 1, dict.fromkeys(counts, "without, nothing is learned"))

    def gpt(self, layout: TokenLayout, state_dim: int) -> GPTConfig:
        """The shape of the GPT for these tokens and states."""
        return GPTConfig(
            state_dim=state_dim,
            tokens_per_step=layout.tokens_per_step,
            scalars=layout.scalars,
            levels=layout.levels,
            width=self.width,
            layers=self.layers,
            heads=self.heads,
            dropout=self.dropout,
            head=self.head,
            head_width=self.head_width,
        )


def pretrain(
    tokenizer: MotionTokenizer,
    clips: Sequence[Clip],
    config: PretrainConfig,
    out: Path | str,
    *,
    tokenizer_path: Path | str = "",
    seed: int = 0,
    threads: int = 0,
    quiet: bool = False,
) -> Prior:
    """Record, train and save a prior of the tokenizer's clips in `out`, and return it.

    tokenizer: loaded from an artifact, whose hash the prior keeps. tokenizer_path: that artifact's directory or
    packaged name, noted so that the prior finds it again. threads: of physics and torch; 0 is every core for
    physics and two for torch.
    """
    out = Path(out)
    ranks.alone("pretraining")
    if not tokenizer.hash:
        raise ConfigError(
            "this tokenizer has no hash; save it, then load it with MotionTokenizer.from_pretrained(path)"
        )
    library = ClipLibrary.of(clips)
    require_character(library, tokenizer.config.character)
    identity = {
        "tokenizer": tokenizer.hash,
        "seed": seed,
    } | library.identity()
    shape = config.gpt(tokenizer.layout, tokenizer.sizes["state"])
    start = _start(config.start, shape) if config.start else None
    refuse_foreign(out, "prior")
    out.mkdir(parents=True, exist_ok=True)
    data = _recorded(tokenizer, library, config, out / "tokens.safetensors", identity, threads=threads, quiet=quiet)
    torch.manual_seed(seed)
    gpt = GPT(shape)
    gpt.set_state_statistics_(*data.statistics())
    if start is not None:
        gpt.load_state_dict(gpt_weights(start))
        identity |= {"start": start.hash}

    plain = out / "plain" if config.refine.rounds else out

    def save(average: GPT, metrics: dict[str, float], where: Path = plain) -> None:
        prior = Prior(
            gpt=average,
            tokenizer=tokenizer,
            tokenizer_path=noted_path(tokenizer_path, where) if tokenizer_path else "",
            clips=data.names,
            starts=data.starts,
        )
        prior.save_pretrained(where, prior_card(prior, config, data, metrics, seed))

    best = train(gpt, data, config, out, identity=identity, save=save, seed=seed, threads=threads, quiet=quiet)
    if config.refine.rounds:
        prior, hold = Prior.from_pretrained(plain, tokenizer), data.split(config.held_out, EVAL_SAMPLES)[1]
        refine(
            prior,
            data,
            config.refine,
            out / "refine",
            identity=identity | {"stage": to_dict(config.refine), "plain": load_artifact(plain).hash},
            save=lambda refined, metrics: save(refined.gpt, best | evaluate(refined.gpt, data, hold) | metrics, out),
            seed=seed,
            threads=threads,
            quiet=quiet,
        )
    return Prior.from_pretrained(out, tokenizer)


def train(
    gpt: GPT,
    data: TokenDataset,
    config: PretrainConfig,
    out: Path,
    *,
    identity: dict[str, Any],
    save: Callable[[GPT, dict[str, float]], None],
    seed: int = 0,
    threads: int = 0,
    quiet: bool = False,
) -> dict[str, float]:
    """Fit `gpt` in place to the data; returns the metrics of the best evaluation.

    save(average, metrics): called with the averaged GPT whenever it is the best so far by held-out cross-entropy, or
    at every evaluation where nothing is held out. identity: what else than the config a run must share with another
    to go on from it.
    """
    average = copy.deepcopy(gpt).eval().requires_grad_(False)
    optimizer = _optimizer(gpt, config)
    generator = seeded(seed)
    learn, hold = data.split(config.held_out, EVAL_SAMPLES)
    step, best = 0, {"held_out/cross_entropy": math.inf}
    parts = {"gpt": gpt, "average": average, "optimizer": optimizer, "generator": generator}
    own = identity | {"config": to_dict(replace(config, refine=RefineConfig(rounds=0)))}  # refining comes after
    state = State(out, parts | {"dropout": torch.default_generator}, identity=own, kinds={"config": PretrainConfig})
    if before := state.restore():
        step, best = before[0]["step"], before[1]["best"]
    gpt.train()
    log = Logger(out, total=config.iterations, title="pretrain", start=step, quiet=quiet)
    with torch_threads(threads or THREADS), log:
        while step < config.iterations:
            metrics = _learn(gpt, average, optimizer, data, learn, config, step, generator)
            step += 1
            told = {f"train/{name}": float(value) for name, value in metrics.items()} if step % LOG_EVERY == 0 else {}
            evaluating = step % config.eval_every == 0 or step == config.iterations
            if evaluating:
                found = evaluate(average, data, hold)
                told |= found
                if not len(hold) or found["held_out/cross_entropy"] < best["held_out/cross_entropy"]:
                    best = found | {"iteration": float(step)}
                    save(average, best)
            if told:
                log.write(step - 1, told)
            if evaluating:
                state.save({"step": step}, best=best)
    return best


@torch.no_grad()
def evaluate(gpt: GPT, data: TokenDataset, ids: Tensor) -> dict[str, float]:
    """`held_out` of a GPT."""
    return held_out(lambda part: gpt.loss(data.states[part], data.tokens[part].long())[1], ids)


@torch.no_grad()
def held_out(measure: Callable[[Tensor], dict[str, Tensor]], ids: Tensor) -> dict[str, float]:
    """Cross-entropy in nats per token and accuracy of the samples ids; nothing where there are none. measure: both, as
    means over some of the samples."""
    sums = dict.fromkeys(("cross_entropy", "accuracy"), 0.0)
    for part in ids.split(1024):
        metrics = measure(part)
        sums = {name: total + float(metrics[name]) * len(part) for name, total in sums.items()}
    return {f"held_out/{name}": total / len(ids) for name, total in sums.items()} if len(ids) else {}


def learning_rate(step: int, config: PretrainConfig) -> float:
    """Linear warm-up, then a cosine from lr to lr_end."""
    if step < config.warmup:
        return config.lr * (step + 1) / config.warmup
    share = (step - config.warmup) / max(config.iterations - config.warmup, 1)
    return config.lr_end + (config.lr - config.lr_end) * (1 + math.cos(math.pi * share)) / 2


def _learn(
    gpt: GPT,
    average: GPT,
    optimizer: torch.optim.Optimizer,
    data: TokenDataset,
    learn: Tensor,
    config: PretrainConfig,
    step: int,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """One step of AdamW on a random batch, and one of the average; metrics of the batch."""
    for group in optimizer.param_groups:
        group["lr"] = learning_rate(step, config)
    ids = learn[torch.randint(len(learn), (config.batch,), generator=generator)]
    state = data.states[ids]
    noise = config.state_noise * torch.randn(state.shape, generator=generator)
    loss, metrics = gpt.loss(state + noise * gpt.state_std, data.tokens[ids].long(), config.label_smoothing)
    if not torch.isfinite(loss):
        raise FloatingPointError(f"the loss is {loss.item()} at iteration {step}; try a smaller --set lr")
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(gpt.parameters(), 1.0)
    optimizer.step()
    share = 1 - min(config.ema, (1 + step) / (10 + step))
    with torch.no_grad():
        for mean, weight in zip(average.parameters(), gpt.parameters(), strict=True):
            mean.lerp_(weight, share)
    return {"loss": loss.detach()} | metrics


def _optimizer(gpt: GPT, config: PretrainConfig) -> torch.optim.Optimizer:
    matrices = [p for p in gpt.parameters() if p.ndim >= 2]
    rest = [p for p in gpt.parameters() if p.ndim < 2]
    groups = [{"params": matrices, "weight_decay": config.weight_decay}, {"params": rest, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=config.lr, betas=(0.9, 0.95), fused=True)


def _start(path: str, shape: GPTConfig) -> Artifact:
    """The prior that training begins with, its state statistics included."""
    artifact = load_artifact(path, kind="prior")
    changed = diff(artifact.config["gpt"], to_dict(shape))
    if changed:
        raise ConfigError(f"start {path} is a prior of another shape: {'; '.join(changed)}")
    return artifact


def _recorded(
    tokenizer: MotionTokenizer,
    library: ClipLibrary,
    config: PretrainConfig,
    path: Path,
    identity: dict[str, Any],
    *,
    threads: int,
    quiet: bool,
) -> TokenDataset:
    """The data at `path`, recorded now unless an earlier call did."""
    if path.exists():
        data, before = TokenDataset.load(path)
        _same_run(path, before, identity, config, RECORDING)
        return data
    table = ReferenceTable(library, control_hz=tokenizer.config.scene.control_hz)
    data = record(
        tokenizer,
        table,
        samples=config.samples,
        rows=config.rows,
        seed=identity["seed"],
        threads=threads,
        env=config.env,
        transitions=config.transitions,
        code_noise=config.code_noise,
        reach_at_end=config.reach_at_end,
        wander=config.wander,
        quiet=quiet,
    )
    data.save(path, identity | {"config": to_dict(config)})
    return data


def _same_run(
    path: Path, before: dict[str, Any], identity: dict[str, Any], config: PretrainConfig, keys: Sequence[str]
) -> None:
    """Refuse what another run left at `path`, by identity or any of these keys of the config; keys that the earlier
    version did not know had their defaults."""
    then = from_dict(PretrainConfig, before["config"])
    old, new = ({"config": {key: to_dict(c)[key] for key in keys}} for c in (then, config))
    changed = diff(before | old, identity | new)
    if changed:
        raise CheckpointError(
            f"{path}: started with another configuration: {'; '.join(changed)}; "
            "repeat the old settings to go on, or choose another --out"
        )


def prior_card(prior: Prior, config: PretrainConfig, data: TokenDataset, metrics: dict[str, float], seed: int) -> str:
    """The model card: use, training, inputs and outputs, results and limits."""
    layout, size = prior.tokenizer.layout, sum(p.numel() for p in prior.gpt.parameters())
    begun = "from an earlier prior" if config.start else "from nothing"
    chance = math.log(layout.vocabulary)
    held = (
        f"Held out ({config.held_out:.0%} of the worlds, iteration {metrics['iteration']:.0f} of {config.iterations}): "
        f"cross-entropy {metrics['held_out/cross_entropy']:.3f} nats per token (uniform: {chance:.3f}), accuracy "
        f"{metrics['held_out/accuracy']:.1%}."
        if "held_out/accuracy" in metrics
        else f"Nothing was held out; iteration {metrics['iteration']:.0f} of {config.iterations}."
    )
    refined = (
        f"round {metrics['round'] + 1:.0f} of {config.refine.rounds}, survival {metrics['survival']:.0%} of "
        f"{config.refine.episodes} episodes of {config.refine.survive:g} s"
        if "round" in metrics
        else "no"
    )
    return f"""# Motion prior for `{prior.tokenizer.config.character}`

A GPT that predicts the motion tokens of a control step from the character's state, {prior.fps} times a second; the
frozen tokenizer {prior.tokenizer.hash[:12]} turns them into joint torques.

    from kinetok.gpt.controller import Prior, roll
    recording = roll(Prior.from_pretrained("PATH"), rows=16, seconds=20, seed=0)

- Input: proprioception ({prior.gpt.config.state_dim} numbers). Output: {layout.tokens_per_step} tokens from a
  vocabulary of {layout.vocabulary}. {size:,} parameters; `{to_dict(prior.gpt.config)}`.
- Data: {len(data):,} control steps of the tracker's own roll-outs, pushes up to {config.env.push} m/s,
  {config.transitions} changes of clip per second, code noise {config.code_noise}. Seed {seed}.
- Clips: {", ".join(prior.clips)}.
- Training: {config.iterations} iterations of {config.batch}, AdamW {config.lr}, label smoothing
  {config.label_smoothing}, EMA {config.ema}, state noise {config.state_noise}; {begun}.
- Refined by its own roll-outs: {refined}.
- It holds {len(prior.starts.qpos)} start states of the clips, so that it runs without them.

{held}

How long it stays up and how varied it is: `kinetok evaluate prior --prior PATH`.

Limits: flat floor, no memory of earlier states, the motions above. Licence: Apache-2.0.
"""
