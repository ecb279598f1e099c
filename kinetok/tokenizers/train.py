"""Train a tracker by PPO through the simulated tracking loop (GPC sec. 5).

    score = train_ppo(actor, table, PPOStage(), out, seed=0, threads=2)

One function for both uses: a *teacher* (continuous code, residual action) from nothing, and the tokenizer itself
end to end, gradients straight through the bottleneck, from nothing (the paper's form) or from a distilled start.
From a start the critic learns first (`critic_warmup`), and the policy may be held near its start (`ppo.anchor`).

`out` receives metrics.jsonl, the best artifact by `track`, and state.safetensors: a later call with the same
configuration goes on bit for bit where that state was written; a changed one is refused, saying what changed.
A loss that is not finite stops the run, keeps the last good state and dumps the offending rollout.
"""

import copy
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from kinetok.checkpoint import CheckpointError, flatten, load_state, save_state, unflatten
from kinetok.config import diff, to_dict
from kinetok.logger import Logger
from kinetok.rl.nets import Critic
from kinetok.rl.ppo import Optimizers, PPOConfig, update
from kinetok.rl.returns import gae
from kinetok.rl.rollout import Rollout, collect
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers.tokenizer import MotionTokenizer
from kinetok.tokenizers.track import TrackingScore, track


@dataclass(frozen=True, kw_only=True)
class PPOStage:
    """samples: control steps to train for; rows: worlds; eval_every: samples between evaluations of `eval_episodes`
    episodes a clip; stop_success, stop_mpjpe_mm: end early when an evaluation reaches both; critic_warmup: first
    iterations that leave the policy alone; fail_mean: training's termination, metres of mean body error."""

    samples: int = 2_000_000
    rows: int = 512
    eval_every: int = 160_000
    eval_episodes: int = 16
    stop_success: float = 2.0
    stop_mpjpe_mm: float = 0.0
    critic: tuple[int, ...] = (256, 128)
    critic_warmup: int = 0
    fail_mean: float = 0.3
    env: EnvConfig = EnvConfig()
    ppo: PPOConfig = field(default_factory=PPOConfig)


@dataclass
class Progress:
    """What a run knows of itself besides its tensors."""

    iteration: int = 0
    samples: int = 0
    evaluated: int = 0
    best: float = -1e9


def train_ppo(
    actor: MotionTokenizer,
    table: ReferenceTable,
    config: PPOStage,
    out: Path,
    *,
    seed: int = 0,
    threads: int = 0,
    title: str = "ppo",
    card: Callable[[TrackingScore], str] = lambda score: "",
    quiet: bool = False,
) -> TrackingScore:
    """Train `actor` in place; returns the score of the best artifact, which lies in `out`."""
    future, scene = actor.config.future, actor.config.scene
    task = Tracking(TrackingConfig(future=future, fail_mean=config.fail_mean), table, rows=config.rows)
    env = Env(config.env, task, rows=config.rows, threads=threads, seed=seed)
    torch.manual_seed(seed)
    critic = Critic(env.obs_size, config.critic, actor.config.activation)
    optimizers = Optimizers(actor, critic, config.ppo)
    generator = torch.Generator().manual_seed(seed)
    anchor = copy.deepcopy(actor) if config.ppo.anchor else None
    run = _Run(out, actor, critic, optimizers, generator, env, anchor, config, seed)
    progress = run.resume()

    def evaluate() -> TrackingScore:
        return track(actor, table, future=future, scene=scene, episodes=config.eval_episodes, threads=threads)

    best: TrackingScore | None = None
    per_iteration = config.rows * config.ppo.horizon
    with Logger(out, total=config.samples, title=title, start=progress.samples, quiet=quiet) as log:
        obs = torch.from_numpy(env.reset(spread=True))
        while progress.samples < config.samples:
            share = min(progress.samples / config.samples, 1.0)
            log_std = config.ppo.log_std[0] + share * (config.ppo.log_std[1] - config.ppo.log_std[0])
            rollout = collect(env, actor, critic, obs, horizon=config.ppo.horizon, log_std=log_std, generator=generator)
            obs = rollout.last_obs
            if progress.iteration > 0:
                metrics = _learn(run, rollout, log_std, progress.iteration > config.critic_warmup)
            else:
                metrics = {}  # the first rollout only sets the normalisers
            if not (progress.iteration == 0 and float(actor.norm.count) > 0):
                actor.observe(rollout.obs)
            critic.observe(rollout.obs)
            progress.iteration += 1
            progress.samples += per_iteration
            if progress.samples >= progress.evaluated + config.eval_every or progress.samples >= config.samples:
                progress.evaluated = progress.samples
                score = evaluate()
                metrics |= {f"track/{k}": v for k, v in score.summary().items()}
                if score.merit > progress.best:
                    progress.best, best = score.merit, score
                    actor.save_pretrained(out, card(score))
                run.save(progress)
                obs = torch.from_numpy(env.reset(spread=True))
            log.write(progress.samples, metrics | env.episode_metrics())
            if best is not None and "track/success" in metrics and _good_enough(best, config):
                break
    if best is None:
        best = evaluate()
    actor.load_state_dict(MotionTokenizer.from_pretrained(out).state_dict())
    return best


def _good_enough(score: TrackingScore, config: PPOStage) -> bool:
    return score.success.mean() >= config.stop_success and score.mpjpe_mm.mean() <= config.stop_mpjpe_mm


class _Run:
    """The mutable parts of one training, saved and restored together."""

    def __init__(self, out, actor, critic, optimizers, generator, env, anchor, config: PPOStage, seed: int):
        self.out, self.actor, self.critic, self.optimizers = out, actor, critic, optimizers
        self.generator, self.env, self.anchor, self.config = generator, env, anchor, config
        self.identity = {"stage": to_dict(config), "tokenizer": to_dict(actor.config), "seed": seed}

    @property
    def path(self) -> Path:
        return self.out / "state.safetensors"

    def _tree(self) -> dict:
        tree = {
            "actor": dict(self.actor.state_dict()),
            "critic": dict(self.critic.state_dict()),
            "optimizers": self.optimizers.state_dict(),
            "generator": self.generator.get_state(),
        }
        return tree | ({"anchor": dict(self.anchor.state_dict())} if self.anchor is not None else {})

    def save(self, progress: Progress) -> None:
        tensors, skeleton = flatten(self._tree())
        meta = {"tree": skeleton, "identity": self.identity, "progress": vars(progress)}
        save_state(self.path, tensors, meta | {"env": json.dumps(self.env.state_dict())})

    def resume(self) -> Progress:
        if not self.path.exists():
            return Progress()
        tensors, meta = load_state(self.path)
        changed = diff(meta["identity"], self.identity)
        if changed:
            raise CheckpointError(
                f"{self.path}: this run was started with another configuration: {'; '.join(changed)}. "
                "Repeat the old settings to go on, or choose another --out"
            )
        tree = unflatten(tensors, meta["tree"])
        self.actor.load_state_dict(tree["actor"])
        self.critic.load_state_dict(tree["critic"])
        self.optimizers.load_state_dict(tree["optimizers"])
        self.generator.set_state(tree["generator"])
        if self.anchor is not None:
            self.anchor.load_state_dict(tree["anchor"])
        self.env.load_state_dict(json.loads(meta["env"]))
        return Progress(**meta["progress"])


def _learn(run: _Run, rollout: Rollout, log_std: float, train_actor: bool) -> dict[str, float]:
    config = run.config.ppo
    try:
        advantages, targets = gae(
            rollout.rewards, rollout.values, rollout.next_values, rollout.done, config.gamma, config.lam
        )
        metrics = update(
            run.actor,
            run.critic,
            run.optimizers,
            rollout,
            advantages,
            targets,
            config,
            log_std=log_std,
            generator=run.generator,
            train_actor=train_actor,
            anchor=run.anchor,
        )
    except FloatingPointError as error:
        dump = run.out / "bad_rollout.safetensors"
        save_state(dump, {"obs": rollout.obs, "actions": rollout.actions, "rewards": rollout.rewards}, {})
        raise FloatingPointError(
            f"{error}; training stopped. The rollout is in {dump}; the last good state in {run.path} is untouched. "
            "Try a smaller --set ppo.lr, or look at the clip with `kinetok clips info`"
        ) from error
    if not np.isfinite(list(metrics.values())).all():
        raise FloatingPointError(f"metrics are not finite: {metrics}; the last good state is {run.path}")
    metrics["failed_simulations"] = run.env.failed_simulations
    metrics["log_std"] = log_std
    return metrics
