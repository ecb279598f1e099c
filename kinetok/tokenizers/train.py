"""Train a tracker by PPO through the simulated tracking loop (GPC sec. 5).

    score = train_ppo(actor, table, PPOStage(), out, seed=0, threads=2)

One function for both uses: a *teacher* (continuous code, residual action) from nothing, and the tokenizer itself
end to end, gradients straight through the bottleneck, from nothing (the paper's form) or from a distilled start.
From a start the critic learns first (`critic_warmup`), and the policy may be held near its start (`anchor`).

`out` receives the best artifact by `track` beside what every training leaves (rl.training).
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from kinetok.checkpoint import CheckpointError, load_state
from kinetok.config import ConfigError, at_least, below, diff, to_dict
from kinetok.rl import ranks
from kinetok.rl.average import AVERAGED, Average
from kinetok.rl.nets import Critic
from kinetok.rl.policy import Gaussian
from kinetok.rl.ppo import PPOConfig
from kinetok.rl.training import JUDGE, Progress, Training
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.reward import TrackingReward
from kinetok.sim.scene import SceneConfig
from kinetok.sim.tasks.roaming import Arriving
from kinetok.sim.tasks.tracking import Failure, ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers.tokenizer import MotionTokenizer, TokenizerConfig
from kinetok.tokenizers.track import TrackingScore, track

COUNTS = {
    "samples": "to leave the stage out, take its name from stages",
    "rows": "it is the number of worlds",
    "eval_every": "give as many as samples for a single evaluation at the end",
    "eval_episodes": "the best artifact is found by evaluations",
}  # of a stage, with what to do about one that is below 1


@dataclass(frozen=True, kw_only=True)
class PPOStage:
    """samples: control steps to train for; rows: worlds; eval_every: samples between evaluations of `eval_episodes`
    episodes a clip; stop_success, stop_mpjpe_mm: end early when an evaluation reaches both; patience: or when, with
    stop_success reached, the best score is so many evaluations old; critic_warmup: first iterations that leave the
    policy alone; log_std: spread of the actions at the first and the last iteration; anchor: pull towards the policy
    it started from; ema: factor of the average of the weights over updates, which is then what is judged and kept
    (rl/average.py), 0 for the last ones themselves; keep: the artifact of the best evaluation, in which one episode
    lost outweighs any millimetres, or of the last, to go on from; failure: when training's episodes end, leniency: its
    limits at the first iteration, as a multiple of those, which they come down to evenly; eval_push: evaluations push
    the root by so many m/s every two seconds; arrivals: share of the episodes that begin in a state of another
    clip, within `reach` metres of roaming.likeness, so that motions can go over into one another; from_start: share of
    the episodes that begin at their clip's first frame, in the place of anywhere in it."""

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
    ema: float = 0.0
    keep: Literal["best", "last"] = "best"
    failure: Failure = Failure()
    leniency: float = 1.0
    eval_push: float = 0.0
    arrivals: float = 0.0
    reach: float = 0.4
    from_start: float = 0.0
    reward: TrackingReward = TrackingReward()
    env: EnvConfig = EnvConfig()
    ppo: PPOConfig = field(default_factory=PPOConfig)

    def __post_init__(self) -> None:
        at_least(self, 1, COUNTS)
        at_least(self, 0, dict.fromkeys(("critic_warmup", "patience", "anchor", "ema"), "0 is none"))
        below(self, 1, AVERAGED)
        if not self.leniency >= 1:
            raise ConfigError(f"leniency must be at least 1, not {self.leniency}; 1 is none")
        if not (0 <= self.arrivals <= 1 and self.reach > 0):
            raise ConfigError(f"arrivals is a share and reach above 0 m, not {self.arrivals} and {self.reach}")


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
    parents: dict[str, str] | None = None,
    others: ReferenceTable | None = None,
    quiet: bool = False,
) -> TrackingScore:
    """Train `actor` in place; returns the score of the best artifact, which lies in `out`.

    others: clips to arrive from, see `arrivals`; by default the table's own. parents: hashes of what the actor was
    made from, kept in the artifact; a state that had others is refused.
    """
    identity = identify(config, actor.config, table.identity, seed) | ({"parents": parents} if parents else {})
    refuse_other_parents(out / "state.safetensors", parents or {})
    future, scene = actor.config.future, actor.config.scene
    tracking = TrackingConfig(future=future, failure=config.failure, reward=config.reward, from_start=config.from_start)
    rows, threads = ranks.share(config.rows, "rows"), ranks.threads(threads)
    task = Tracking(tracking, table, rows=rows)
    if config.arrivals:
        origins = others or table
        share, reach = config.arrivals, config.reach
        task = Arriving(tracking, table, origins, rows=rows, share=share, reach=reach)
        identity |= {"others": origins.identity}
    env = Env(in_scene(config.env, scene), task, rows=rows, threads=threads, seed=ranks.own(seed))
    torch.manual_seed(seed)
    critic = Critic(env.obs_size, config.critic, actor.config.activation)
    anchor = copy.deepcopy(actor) if config.anchor else None
    policy = Gaussian(actor, config.log_std[0], anchor, config.anchor)
    run = Training(
        out=out,
        world=env,
        policy=policy,
        critic=critic,
        config=config.ppo,
        modules={"actor": actor} | ({"anchor": anchor} if anchor is not None else {}),
        identity=identity,
        kinds=KINDS | {"stage": PPOStage},
        seed=seed,
        average=Average(actor.parameters(), config.ema) if config.ema else None,
    )

    def evaluate() -> TrackingScore:
        episodes, push = config.eval_episodes, config.eval_push
        return track(
            actor, table, future=future, scene=scene, episodes=episodes, push=push, threads=threads, seed=seed + JUDGE
        )

    def settle(share: float) -> None:
        policy.log_std = config.log_std[0] + share * (config.log_std[1] - config.log_std[0])
        task.config = replace(tracking, failure=config.failure.times(1 + (1 - share) * (config.leniency - 1)))

    progress = run.train(
        samples=config.samples,
        eval_every=config.eval_every,
        evaluate=evaluate,
        keep=lambda score: actor.save_pretrained(out, card(score), parents),
        latest=config.keep == "last",
        finished=lambda progress: good_enough(progress, config),
        schedule=settle,
        critic_warmup=config.critic_warmup,
        warm=float(actor.norm.count) > 0,
        title=title,
        prefix="track",
        quiet=quiet,
    )
    actor.load_state_dict(MotionTokenizer.from_pretrained(out).state_dict())
    assert progress.score is not None  # the last sample is always evaluated
    return TrackingScore.from_json(progress.score)


def in_scene(env: EnvConfig, scene: SceneConfig) -> EnvConfig:
    """A stage's world with the tokenizer's physics; refuses a stage that sets another one."""
    changed = diff(scene, env.scene)
    if env.scene != SceneConfig() and changed:
        raise ConfigError(f"a stage's env.scene differs from tokenizer.scene ({'; '.join(changed)}); set the latter")
    return replace(env, scene=scene)


KINDS = {"tokenizer": TokenizerConfig}  # of the identity below, besides its stage


def identify(config: object, tokenizer: TokenizerConfig, clips: dict, seed: int) -> dict:
    """What a run is, for `refuse_changed`: a state goes on only under the same. clips: ClipLibrary.identity."""
    return {"stage": to_dict(config), "tokenizer": to_dict(tokenizer), "seed": seed} | clips


def refuse_other_parents(path: Path, parents: dict[str, str]) -> None:
    """Raise CheckpointError where a state at `path` is of a run that was made from other artifacts than these."""
    if not path.exists():
        return
    before = load_state(path)[1].get("identity", {}).get("parents", {})
    changed = [f"{role} {before.get(role, 'none')[:12]} -> {parents.get(role, 'none')[:12]}"
               for role in before | parents if before.get(role) != parents.get(role)]  # fmt: skip
    if changed:
        raise CheckpointError(
            f"{path}: this run was made from other artifacts: {', '.join(changed)}. "
            f"Remove {path.parent} to make it anew from these, bring the old ones back, or choose another --out"
        )


def good_enough(progress: Progress, config: PPOStage) -> bool:
    """Whether the best score so far ends the run early."""
    if progress.score is None:
        return False
    best = TrackingScore.from_json(progress.score)
    if best.success.mean() < config.stop_success:
        return False
    return best.mpjpe_mm.mean() <= config.stop_mpjpe_mm or progress.stale >= config.patience
