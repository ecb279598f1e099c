"""Train a tracker by PPO through the simulated tracking loop (GPC sec. 5).

    score = train_ppo(actor, table, PPOStage(), out, seed=0, threads=2)

One function for both uses: a *teacher* (continuous code, residual action) from nothing, and the tokenizer itself
end to end, gradients straight through the bottleneck, from nothing (the paper's form) or from a distilled start.
From a start the critic learns first (`critic_warmup`), and the policy may be held near its start (`anchor`).

`out` receives metrics.jsonl, the best artifact by `track`, and state.safetensors: a later call with the same
configuration goes on bit for bit where that state was written; a changed one is refused, saying what changed.
A loss that is not finite stops the run, keeps the last good state and dumps the offending rollout.
"""

import copy
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from kinetok.checkpoint import CheckpointError, flatten, load_state, save_state, unflatten
from kinetok.config import ConfigError, diff, from_dict, to_dict
from kinetok.logger import Logger
from kinetok.rl.nets import Critic
from kinetok.rl.policy import Gaussian
from kinetok.rl.ppo import Optimizers, PPOConfig, update
from kinetok.rl.returns import gae
from kinetok.rl.rollout import Rollout, collect
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.reward import TrackingReward
from kinetok.sim.scene import SceneConfig
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers.tokenizer import MotionTokenizer, TokenizerConfig
from kinetok.tokenizers.track import TrackingScore, track


@dataclass(frozen=True, kw_only=True)
class PPOStage:
    """samples: control steps to train for; rows: worlds; eval_every: samples between evaluations of `eval_episodes`
    episodes a clip; stop_success, stop_mpjpe_mm: end early when an evaluation reaches both; patience: or when, with
    stop_success reached, the best score is so many evaluations old; critic_warmup: first
    iterations that leave the policy alone; log_std: spread of the actions at the first and the last iteration;
    anchor: pull towards the policy it started from; fail_mean: training's termination, metres of mean body error."""

    samples: int = 2_000_000
    rows: int = 512
    eval_every: int = 160_000
    eval_episodes: int = 16
    stop_success: float = 2.0
    stop_mpjpe_mm: float = 0.0
    patience: int = 1000
    critic: tuple[int, ...] = (256, 128)
    critic_warmup: int = 0
    log_std: tuple[float, float] = (-2.6, -2.9)
    anchor: float = 0.0
    fail_mean: float = 0.3
    reward: TrackingReward = TrackingReward()
    env: EnvConfig = EnvConfig()
    ppo: PPOConfig = field(default_factory=PPOConfig)


@dataclass
class Progress:
    """What a run knows of itself besides its tensors. best, score: merit and score of the artifact that was kept;
    stale: evaluations since."""

    iteration: int = 0
    samples: int = 0
    evaluated: int = 0
    best: float = -1e9
    stale: int = 0
    score: TrackingScore | None = None

    def finished(self, config: PPOStage) -> bool:
        good = self.score is not None and _good_enough(self.score, self.stale, config)
        return good or self.samples >= config.samples

    def to_json(self) -> dict:
        return vars(self) | {"score": self.score and self.score.to_json()}

    @staticmethod
    def from_json(data: dict) -> "Progress":
        progress = Progress(**{**data, "score": None})
        if data.get("score"):
            progress.score = TrackingScore.from_json(data["score"])
        return progress


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
    task = Tracking(
        TrackingConfig(future=future, fail_mean=config.fail_mean, reward=config.reward), table, rows=config.rows
    )
    env = Env(in_scene(config.env, scene), task, rows=config.rows, threads=threads, seed=seed)
    torch.manual_seed(seed)
    critic = Critic(env.obs_size, config.critic, actor.config.activation)
    optimizers = Optimizers(actor, critic, config.ppo)
    generator = torch.Generator().manual_seed(seed)
    anchor = copy.deepcopy(actor) if config.anchor else None
    policy = Gaussian(actor, config.log_std[0], anchor, config.anchor)
    identity = identify(config, actor.config, table.names, seed)
    run = _Run(out, actor, critic, optimizers, generator, env, anchor, identity)
    progress = run.resume()

    def evaluate() -> TrackingScore:
        return track(actor, table, future=future, scene=scene, episodes=config.eval_episodes, threads=threads)

    per_iteration = config.rows * config.ppo.horizon
    start = progress.samples + per_iteration
    with Logger(out, total=config.samples, title=title, start=start, quiet=quiet) as log:
        obs = torch.from_numpy(env.reset(spread=True))
        while not progress.finished(config):
            share = min(progress.samples / config.samples, 1.0)
            policy.log_std = config.log_std[0] + share * (config.log_std[1] - config.log_std[0])
            rollout = collect(env, policy, critic, obs, horizon=config.ppo.horizon, generator=generator)
            obs = rollout.last_obs
            if progress.iteration > 0:
                metrics = _learn(run, policy, rollout, config.ppo, progress.iteration > config.critic_warmup)
            else:
                metrics = {}  # the first rollout only sets the normalisers
            if not (progress.iteration == 0 and float(actor.norm.count) > 0):
                actor.observe(rollout.obs)
            critic.observe(rollout.obs)
            progress.iteration += 1
            progress.samples += per_iteration
            due = progress.samples >= min(progress.evaluated + config.eval_every, config.samples)
            if due:
                progress.evaluated = progress.samples
                score = evaluate()
                metrics |= {f"track/{k}": v for k, v in score.summary().items()}
                progress.stale += 1
                if score.merit > progress.best:
                    progress.best, progress.stale, progress.score = score.merit, 0, score
                    actor.save_pretrained(out, card(score))
            log.write(progress.samples, metrics | env.episode_metrics())
            if due:
                run.save(progress)
                obs = torch.from_numpy(env.reset(spread=True))
    actor.load_state_dict(MotionTokenizer.from_pretrained(out).state_dict())
    return progress.score or evaluate()


def in_scene(env: EnvConfig, scene: SceneConfig) -> EnvConfig:
    """A stage's world with the tokenizer's physics; refuses a stage that sets another one."""
    changed = diff(scene, env.scene)
    if env.scene != SceneConfig() and changed:
        raise ConfigError(f"a stage's env.scene differs from tokenizer.scene ({'; '.join(changed)}); set the latter")
    return replace(env, scene=scene)


def identify(config: object, tokenizer: TokenizerConfig, names: Sequence[str], seed: int) -> dict:
    """What a run is, for `refuse_changed`: a state goes on only under the same."""
    return {"stage": to_dict(config), "tokenizer": to_dict(tokenizer), "seed": seed, "clips": list(names)}


def refuse_changed(path: Path, old: dict, new: dict, stage: type) -> None:
    """Raise CheckpointError where the state at `path` is of another run; settings it does not know had the default."""
    old = {"clips": new["clips"]} | old
    old |= {k: to_dict(from_dict(t, old[k])) for k, t in (("stage", stage), ("tokenizer", TokenizerConfig))}
    changed = diff(old, new)
    if changed:
        raise CheckpointError(
            f"{path}: this run was started with another configuration: {'; '.join(changed)}. "
            "Repeat the old settings to go on, or choose another --out"
        )


def _good_enough(best: TrackingScore, stale: int, config: PPOStage) -> bool:
    if best.success.mean() < config.stop_success:
        return False
    return best.mpjpe_mm.mean() <= config.stop_mpjpe_mm or stale >= config.patience


class _Run:
    """The mutable parts of one training, saved and restored together."""

    def __init__(self, out, actor, critic, optimizers, generator, env, anchor, identity: dict):
        self.out, self.actor, self.critic, self.optimizers = out, actor, critic, optimizers
        self.generator, self.env, self.anchor, self.identity = generator, env, anchor, identity

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
        meta = {"tree": skeleton, "identity": self.identity, "progress": progress.to_json()}
        save_state(self.path, tensors, meta | {"env": json.dumps(self.env.state_dict())})

    def resume(self) -> Progress:
        if not self.path.exists():
            return Progress()
        tensors, meta = load_state(self.path)
        refuse_changed(self.path, meta["identity"], self.identity, PPOStage)
        tree = unflatten(tensors, meta["tree"])
        self.actor.load_state_dict(tree["actor"])
        self.critic.load_state_dict(tree["critic"])
        self.optimizers.load_state_dict(tree["optimizers"])
        self.generator.set_state(tree["generator"])
        if self.anchor is not None:
            self.anchor.load_state_dict(tree["anchor"])
        self.env.load_state_dict(json.loads(meta["env"]))
        return Progress.from_json(meta["progress"])


def _learn(run: _Run, policy: Gaussian, rollout: Rollout, config: PPOConfig, train_actor: bool) -> dict[str, float]:
    try:
        advantages, targets = gae(
            rollout.rewards, rollout.values, rollout.next_values, rollout.done, config.gamma, config.lam
        )
        metrics = update(
            policy,
            run.critic,
            run.optimizers,
            rollout,
            advantages,
            targets,
            config,
            generator=run.generator,
            train_actor=train_actor,
        )
        # The last minibatch's gradient has no later loss that would show it.
        finite = [torch.isfinite(p).all() for net in (run.actor, run.critic) for p in net.parameters()]
        if not (np.isfinite(list(metrics.values())).all() and torch.stack(finite).all()):
            raise FloatingPointError(f"parameters or metrics are not finite: {metrics}")
    except FloatingPointError as error:
        dump = run.out / "bad_rollout.safetensors"
        save_state(dump, {"obs": rollout.obs, "rewards": rollout.rewards, **rollout.taken}, {})
        raise FloatingPointError(
            f"{error}; training stopped. The rollout is in {dump}; the last good state in {run.path} is untouched. "
            "Try a smaller --set ppo.lr, or look at the clip with `kinetok clips info`"
        ) from error
    metrics["failed_simulations"] = run.env.failed_simulations
    metrics["log_std"] = policy.log_std
    return metrics
