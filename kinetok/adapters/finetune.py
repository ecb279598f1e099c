"""Fine-tune a prior to a task: a little data, then reward (GPC sec. 7).

    skill = finetune(prior, FinetuneConfig(task=TargetConfig()), Path("runs/target"), base="humanoid-gpt", seed=0)

Three methods, each of which may be left out:

1. sft        cross-entropy on the tokens of example clips, tracked by the frozen tokenizer: a style    out/sft
2. hindsight  cross-entropy on tokens of clips and own ones, given what came of them: the task    out/hindsight
3. rl         PPO over the tokens of a control step, within the frozen prior's nucleus: the task            out

The last one asked for writes to `out` itself. A method begins with the best of the one before it; rl may begin
with the adapter of another skill instead.

What comes out is a `Skill` (skill.py).
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import torch

from kinetok.adapters import ADAPTERS, AdapterConfig, CoLAConfig
from kinetok.adapters.adapted import Adapted, AdaptedConfig, AdapterPart, fingerprint, parameters_of
from kinetok.adapters.hindsight import HindsightConfig, hindsight
from kinetok.adapters.rlft import TaskScore, TokenPolicy, TokenPolicyConfig, play, task_of
from kinetok.adapters.sft import SFTConfig, supervise
from kinetok.adapters.skill import Skill, skill_card
from kinetok.checkpoint import ADAPTER, load_artifact, locate, refuse_foreign
from kinetok.config import ConfigError, at_least, below, diff, nearest, pick, to_dict
from kinetok.gpt.controller import Prior
from kinetok.gpt.pretrain import THREADS
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.rl import ranks
from kinetok.rl.average import AVERAGED, Average
from kinetok.rl.nets import Critic
from kinetok.rl.ppo import PPOConfig
from kinetok.rl.rollout import seeded, torch_threads
from kinetok.rl.training import JUDGE, Training
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks import TASKS, GoalConfig, TargetConfig
from kinetok.sim.tasks.tracking import ReferenceTable
from kinetok.tokenizers.train import COUNTS, in_scene

METHODS = ("sft", "hindsight", "rl")


@dataclass(frozen=True, kw_only=True)
class FinetuneConfig:
    """task; adapter: its kind and shape; methods: of sft, hindsight, rl, in this order; sft; hindsight; policy: how
    tokens are drawn; samples: control steps of rl, in `rows` worlds; eval_every: samples between evaluations of
    `eval_episodes` episodes of eval_seconds; save_every: samples between states to resume from, at the next
    evaluation (the worlds begin anew there, so not too often); critic: widths of the value network on state and
    task; critic_warmup: first iterations that leave the adapter alone; ema: factor of the average of the adapter's
    weights over updates, which is then what is judged and kept (rl/average.py), 0 for the last ones themselves;
    anchor: pull towards the adapter that rl began with, per nat and step; env: the worlds of rl, in the tokenizer's
    scene; ppo."""

    task: GoalConfig = TargetConfig()
    adapter: AdapterConfig = CoLAConfig(rank=16, alpha=32.0)
    methods: tuple[str, ...] = ("rl",)
    sft: SFTConfig = SFTConfig()
    hindsight: HindsightConfig = HindsightConfig()
    policy: TokenPolicyConfig = TokenPolicyConfig()
    samples: int = 3_000_000
    rows: int = 512
    eval_every: int = 200_000
    save_every: int = 750_000
    eval_episodes: int = 64
    eval_seconds: float = 20.0
    critic: tuple[int, ...] = (256, 128)
    critic_warmup: int = 6
    anchor: float = 0.0
    ema: float = 0.0
    env: EnvConfig = EnvConfig(episode_seconds=16.0)
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            horizon=32, epochs=2, minibatch=4096, gamma=0.99, lr=1e-4, lr_max=3e-4, target_kl=0.004
        )
    )

    def __post_init__(self) -> None:
        for method in self.methods:
            if method not in METHODS:
                raise ConfigError(f"unknown method {method!r}{nearest(method, METHODS)}; methods: {', '.join(METHODS)}")
        if not self.methods or list(self.methods) != sorted(set(self.methods), key=METHODS.index):
            raise ConfigError(f"methods {', '.join(self.methods) or '(none)'}: name each once, sft before rl")
        at_least(self, 1, COUNTS | {
            "samples": "to leave rl out, take it from methods",
            "save_every": "give as many as samples for a single state at the end",
        })  # fmt: skip
        at_least(self, 0, {"anchor": "0 is none", "ema": "0 is none"})
        below(self, 1, AVERAGED)
        at_least(self, 0.1, {"eval_seconds": "an episode has one control step at least"})


def reshaped(config: FinetuneConfig, *, task: str, adapter: str) -> FinetuneConfig:
    """The same for the task and the adapter of these kinds; another adapter takes over what it has in common, such as
    rank and alpha."""
    if config.task.kind != task:
        config = replace(config, task=pick(TASKS, task, "task")[0]())
    if config.adapter.kind != adapter:
        kind, _ = pick(ADAPTERS, adapter, "adapter")
        names = {f.name for f in fields(kind)} & {f.name for f in fields(config.adapter)} - {"kind"}
        config = replace(config, adapter=kind(**{name: getattr(config.adapter, name) for name in names}))
    return config


def finetune(
    prior: Prior,
    config: FinetuneConfig,
    out: Path | str,
    *,
    base: Path | str,
    clips: Sequence[Clip] = (),
    start: Path | str | None = None,
    rebase: bool = False,
    seed: int = 0,
    threads: int = 0,
    quiet: bool = False,
) -> Skill:
    """Run the methods that are not finished yet, write the best skill to `out` and return it.

    base: the prior's directory or packaged name, noted in the artifact. clips: examples for sft and hindsight. start:
    the adapter, of the same shape and prior, that rl begins with; rebase: of another prior of the same shape, such as
    this one's predecessor. threads: of physics and torch; 0 is every core for physics and two for torch. Several
    processes may train rl together (rl/ranks.py).
    """
    out = Path(out)
    quiet = quiet or ranks.rank() > 0
    with torch_threads(threads or THREADS):
        return _finetune(prior, config, out, base, clips, start, rebase, seed=seed, threads=threads, quiet=quiet)


def _finetune(
    prior: Prior,
    config: FinetuneConfig,
    out: Path,
    base: Path | str,
    clips: Sequence[Clip],
    start: Path | str | None,
    rebase: bool,
    *,
    seed: int,
    threads: int,
    quiet: bool,
) -> Skill:
    _check(prior, config, clips, start, rebase, out)
    torch.manual_seed(seed)
    adapted = _adapted(prior, config, base, start, rebase)
    skill = Skill(adapted=adapted, prior=prior, base=str(base), task=config.task, policy=config.policy)
    places = {method: out / method for method in config.methods[:-1]} | {config.methods[-1]: out}
    for place in places.values():
        refuse_foreign(place, "adapter", ADAPTER)
    out.mkdir(parents=True, exist_ok=True)
    if not quiet:
        count, frozen, share = parameters_of(adapted)
        said = f"{count:,} parameters, {share:.2%} of the {frozen:,} that stay frozen"
        print(f"{config.adapter.kind} adapter of {said}", flush=True)
    identity = {
        "prior": fingerprint(prior.gpt),
        "tokenizer": prior.tokenizer.hash,
        "start": load_artifact(start, "adapter", ADAPTER).hash if start else "",
        "seed": seed,
    } | (ClipLibrary.of(clips).identity() if clips else {"clips": []})
    told = {"seed": seed, "threads": threads, "quiet": quiet}
    if "sft" in config.methods:
        _imitate(skill, config, places["sft"], clips, identity, **told)
        identity["start"] = _take(skill, places["sft"])
    if "hindsight" in config.methods:
        _look_back(skill, config, places["hindsight"], clips, identity, **told)
        identity["start"] = _take(skill, places["hindsight"])
    if "rl" in config.methods:
        _reinforce(skill, config, out, identity, **told)
        _take(skill, out)
    return skill


def _check(
    prior: Prior, config: FinetuneConfig, clips: Sequence[Clip], start: Path | str | None, rebase: bool, out: Path
) -> None:
    """Refuse what cannot be done, before any of it is."""
    if "sft" in config.methods and not clips:
        raise ConfigError("supervised fine-tuning needs example clips: --clips PATH")
    if clips and config.methods == ("rl",):
        raise ConfigError("reinforcement learning uses no clips; add --method sft or hindsight, or both: hindsight,rl")
    body = prior.tokenizer.config.character
    for clip in clips:
        if clip.character != body:
            raise ConfigError(
                f"clip {clip.name!r} is of {clip.character!r}, the prior moves {body!r}; retarget it first"
            )
    if rebase and start is None:
        raise ConfigError("--rebase takes the skill of --from over to another prior; give that skill")
    if start is not None and config.methods != ("rl",):
        raise ConfigError("another skill's adapter is where reinforcement learning begins: --from needs --method rl")
    if start is not None and out.exists() and out.resolve() == locate(start, ADAPTER).resolve():
        raise ConfigError(f"--from and --out are the same folder, {out}; choose another --out")
    if config.methods != ("rl",):
        ranks.alone(f"--method {','.join(config.methods)}")
    in_scene(config.env, prior.tokenizer.config.scene)


def _adapted(prior: Prior, config: FinetuneConfig, base: Path | str, start: Path | str | None, rebase: bool) -> Adapted:
    """The prior with a fresh adapter, or with that of the skill at `start`."""
    columns = task_of(config.task, prior, 1).layout["task"]
    shape = AdaptedConfig(adapter=config.adapter, cond_dim=columns.stop - columns.start)
    if start is None:
        return Adapted(prior.gpt, shape.adapter, shape.cond_dim)
    adapted = Adapted.from_pretrained(start, prior.gpt, base=base, rebase=rebase)
    changed = diff(AdaptedConfig(adapter=adapted.config, cond_dim=adapted.cond_dim), shape)
    if changed:
        raise ConfigError(
            f"{start} holds an adapter of another shape: {'; '.join(changed)}. "
            "Ask for the same adapter, and for a task whose observation is as wide"
        )
    return adapted


def _take(skill: Skill, place: Path) -> str:
    """Give `skill` the adapter that was saved at `place`; its hash."""
    artifact = load_artifact(place, "adapter", ADAPTER)
    skill.adapted.load_adapter_state_(artifact.tensors)
    return artifact.hash


def _imitate(
    skill: Skill,
    config: FinetuneConfig,
    out: Path,
    clips: Sequence[Clip],
    identity: dict,
    *,
    seed: int,
    threads: int,
    quiet: bool,
) -> None:
    def save(metrics: dict[str, float]) -> None:
        names = ", ".join(clip.name for clip in clips)
        story = f"supervised, {config.sft.iterations} iterations on what the tokenizer does of the clips {names}"
        found = f"Held-out worlds, iteration {metrics['iteration']:.0f}, which was the best"
        measures = {name: value for name, value in metrics.items() if name != "iteration"}
        skill.save_pretrained(out, skill_card(skill, story, seed, found, measures))

    own = {"task": to_dict(config.task), "policy": to_dict(config.policy), "adapter": to_dict(config.adapter)}
    supervise(
        skill.adapted,
        skill.prior.tokenizer,
        clips,
        config.sft,
        out,
        identity=identity | own,
        save=save,
        seed=seed,
        threads=threads,
        quiet=quiet,
    )


def _look_back(
    skill: Skill,
    config: FinetuneConfig,
    out: Path,
    clips: Sequence[Clip],
    identity: dict,
    *,
    seed: int,
    threads: int,
    quiet: bool,
) -> None:
    table = ReferenceTable(ClipLibrary.of(clips), control_hz=skill.prior.fps) if clips else None
    task = task_of(config.task, skill.prior, config.hindsight.rows)
    scene = skill.prior.tokenizer.config.scene
    world = replace(in_scene(config.env, scene), episode_seconds=config.hindsight.seconds + 1)
    env = Env(world, task, rows=config.hindsight.rows, threads=threads, seed=seed)
    policy = TokenPolicy(skill.adapted, skill.prior.tokenizer, config.policy)
    story = f"hindsight, {config.hindsight.rounds} rounds"
    if clips:
        story += f", and what the tokenizer does of the clips {', '.join(clip.name for clip in clips)}"
    own = {"task": to_dict(config.task), "policy": to_dict(config.policy), "adapter": to_dict(config.adapter)}
    hindsight(
        policy,
        env,
        config.hindsight,
        out,
        evaluate=lambda: _judge(policy, skill, config, seed, threads),
        keep=lambda score: _keep(skill, config, out, story, identity["start"], seed, score),
        identity=identity | own,
        table=table,
        asking=lambda: task_of(config.task.restless(config.hindsight.restless), skill.prior, config.hindsight.rows),
        seed=seed,
        threads=threads,
        quiet=quiet,
    )


def _judge(policy: TokenPolicy, skill: Skill, config: FinetuneConfig, seed: int, threads: int) -> TaskScore:
    """What chooses the best of a run: the same episodes every time, which no `evaluate task` asks for."""
    played = play(
        policy.controller(seeded(seed + JUDGE)),
        config.task,
        skill.prior,
        episodes=config.eval_episodes,
        seconds=config.eval_seconds,
        seed=seed + JUDGE,
        threads=threads,
    )
    return played.score


def _keep(skill: Skill, config: FinetuneConfig, out: Path, story: str, start: str, seed: int, score: TaskScore) -> None:
    begun = f", from the adapter {start[:12]}" if start else ""
    found = f"{config.eval_episodes} episodes of {config.eval_seconds:g} s, which chose the best of the run"
    card = skill_card(skill, story + begun, seed, found, score.measures)
    skill.save_pretrained(out, card, {"skill": start} if start else {})


def _reinforce(
    skill: Skill, config: FinetuneConfig, out: Path, identity: dict, *, seed: int, threads: int, quiet: bool
) -> None:
    rows, threads = ranks.share(config.rows, "rows"), ranks.threads(threads)
    task = task_of(config.task, skill.prior, rows)
    world = in_scene(config.env, skill.prior.tokenizer.config.scene)
    env = Env(world, task, rows=rows, threads=threads, seed=ranks.own(seed))
    begun = copy.deepcopy(skill.adapted).requires_grad_(False) if config.anchor else None
    policy = TokenPolicy(skill.adapted, skill.prior.tokenizer, config.policy, begun, config.anchor)
    torch.manual_seed(seed)  # an earlier method may have run in this process or in another one
    run = Training(
        out=out,
        world=env,
        policy=policy,
        critic=Critic(env.obs_size, config.critic),
        config=config.ppo,
        modules={"adapter": AdapterPart(skill.adapted)},
        identity={"stage": to_dict(config)} | identity,
        kinds={"stage": FinetuneConfig},
        seed=seed,
        average=Average(skill.adapted.trainable(), config.ema) if config.ema else None,
    )

    story = f"reinforcement learning, {config.samples:,} control steps at most"
    conditioner = skill.adapted.conditioner
    progress = run.train(
        samples=config.samples,
        eval_every=config.eval_every,
        save_every=config.save_every,
        evaluate=lambda: _judge(policy, skill, config, seed, threads),
        keep=lambda score: _keep(skill, config, out, story, identity["start"], seed, score),
        critic_warmup=config.critic_warmup,
        warm=conditioner is not None and float(conditioner.norm.count) > 0,
        title=f"finetune {config.task.kind}",
        quiet=quiet,
    )
    if not quiet and progress.score is not None:
        best = [f"{name} {value:.3g}" for name, value in progress.score["measures"].items() if type(value) is float]
        print(f"best evaluation: {', '.join(best)}; {out}")
