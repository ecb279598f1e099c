"""Fine-tune a prior to a task: a little data, then reward (GPC sec. 7).

    skill = finetune(prior, FinetuneConfig(task=TargetConfig()), Path("runs/target"), base="humanoid-gpt", seed=0)
    skill = Skill.from_pretrained("runs/target")
    played = play(skill.controller(seed=0), skill.task, skill.prior, episodes=256)

Two methods, each of which may be left out:

1. sft   cross-entropy on the tokens of example clips, tracked by the frozen tokenizer: a style      out/sft
2. rl    PPO over the tokens of a control step, within the frozen prior's nucleus: the task           out

A `Skill` is what comes out: an adapter, the prior it bends and the task it was bent to. Its artifact holds the
adapter alone; the prior stays an artifact of its own, found by the place noted and refused unless it is the one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from kinetok.adapters import AdapterConfig, CoLAConfig
from kinetok.adapters.adapted import Adapted, fingerprint, parameters_of
from kinetok.adapters.rlft import Controller, TaskScore, TokenPolicy, TokenPolicyConfig, play, task_of
from kinetok.adapters.sft import SFTConfig, supervise
from kinetok.checkpoint import ADAPTER, CheckpointError, load_artifact, locate
from kinetok.config import ConfigError, from_dict, nearest, pick, to_dict
from kinetok.gpt.controller import Prior, noted_path
from kinetok.motion.clip import Clip
from kinetok.rl.nets import Critic
from kinetok.rl.ppo import PPOConfig
from kinetok.rl.rollout import torch_threads
from kinetok.rl.training import Training
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks import TASKS, GoalConfig, TargetConfig
from kinetok.tokenizers.train import in_scene

METHODS = ("sft", "rl")


@dataclass(frozen=True, kw_only=True)
class FinetuneConfig:
    """task; adapter: its kind and shape; methods: of sft, rl, in this order; policy: how tokens are drawn; samples:
    control steps of rl, in `rows` worlds; eval_every: samples between evaluations of `eval_episodes` episodes of
    eval_seconds; critic: widths of the value network on state and task; critic_warmup: first iterations that leave the
    adapter alone."""

    task: GoalConfig = TargetConfig()
    adapter: AdapterConfig = CoLAConfig(rank=16, alpha=32.0)
    methods: tuple[str, ...] = ("rl",)
    sft: SFTConfig = SFTConfig()
    policy: TokenPolicyConfig = TokenPolicyConfig()
    samples: int = 2_000_000
    rows: int = 512
    eval_every: int = 100_000
    eval_episodes: int = 64
    eval_seconds: float = 20.0
    critic: tuple[int, ...] = (256, 128)
    critic_warmup: int = 5
    env: EnvConfig = EnvConfig(episode_seconds=16.0)
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            epochs=1, minibatch=1024, gamma=0.98, lr=5e-4, lr_max=2e-3, target_kl=0.03, critic_lr=1e-3
        )
    )

    def __post_init__(self) -> None:
        for method in self.methods:
            if method not in METHODS:
                raise ConfigError(f"unknown method {method!r}{nearest(method, METHODS)}; methods: {', '.join(METHODS)}")
        if not self.methods or list(self.methods) != sorted(set(self.methods), key=METHODS.index):
            raise ConfigError(f"methods {self.methods}: name each once, sft before rl")


@dataclass(frozen=True, kw_only=True, eq=False)
class Skill:
    """adapted: the bent prior, in eval mode; prior; task: what it was bent to; policy: how its tokens are drawn."""

    adapted: Adapted
    prior: Prior
    task: GoalConfig
    policy: TokenPolicyConfig

    def controller(self, seed: int | None = 0) -> Controller:
        """Observations of the task to PD targets; seed None takes the most probable tokens."""
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        layout = task_of(self.task, self.prior, 1).layout
        return TokenPolicy(self.adapted, self.prior.tokenizer, layout, self.policy).controller(generator)

    def save_pretrained(self, path: Path | str, *, base: Path | str, card: str | None = None) -> None:
        """Write the adapter's directory. base: the prior's directory or packaged name."""
        noted = noted_path(base, path)
        skill = {"prior": noted, "task": to_dict(self.task), "policy": to_dict(self.policy)}
        self.adapted.save_pretrained(path, base=noted, card=card, skill=skill)

    @staticmethod
    def from_pretrained(path: Path | str, prior: Prior | Path | str | None = None) -> "Skill":
        """Load an adapter by directory or packaged name, with its prior: `prior`, itself or its directory, if given,
        else the one at the noted place."""
        artifact = load_artifact(path, "adapter", ADAPTER)
        skill = artifact.config["skill"]
        if skill is None:
            raise CheckpointError(f"{artifact.path} is an adapter that says nothing of a task; it cannot be played")
        if not isinstance(prior, Prior):
            wanted = skill["prior"] if prior is None else str(prior)
            places = [artifact.path / wanted, locate(wanted)] if prior is None else [locate(wanted)]
            found = next((place for place in places if place.is_dir()), None)
            if found is None:
                raise CheckpointError(f"{artifact.path}: its prior is not at {wanted!r}; give its place, --prior DIR")
            prior = Prior.from_pretrained(found)
        return Skill(
            adapted=Adapted.from_pretrained(artifact.path, prior.gpt, base=skill["prior"]),
            prior=prior,
            task=from_dict(pick(TASKS, skill["task"]["kind"], "task")[0], skill["task"]),
            policy=from_dict(TokenPolicyConfig, skill["policy"]),
        )


def finetune(
    prior: Prior,
    config: FinetuneConfig,
    out: Path,
    *,
    base: Path | str,
    clips: Sequence[Clip] = (),
    seed: int = 0,
    threads: int = 0,
    quiet: bool = False,
) -> Skill:
    """Run the methods that are not finished yet and write the best skill to `out`.

    base: the prior's directory or packaged name, noted in the artifact. clips: examples for sft.
    """
    with torch_threads(threads or torch.get_num_threads()):
        return _finetune(prior, config, out, base=base, clips=clips, seed=seed, threads=threads, quiet=quiet)


def _finetune(prior, config: FinetuneConfig, out: Path, *, base, clips, seed: int, threads: int, quiet: bool) -> Skill:
    if "sft" in config.methods and not clips:
        raise ConfigError("supervised fine-tuning needs example clips: --clips PATH")
    if clips and "sft" not in config.methods:
        raise ConfigError("the clips are used by supervised fine-tuning alone; add --method sft, or both: sft,rl")
    task = task_of(config.task, prior, config.rows)
    env = Env(in_scene(config.env, prior.tokenizer.config.scene), task, rows=config.rows, threads=threads, seed=seed)
    torch.manual_seed(seed)
    width = task.layout["task"].stop - task.layout["task"].start
    adapted = Adapted(prior.gpt, config.adapter, cond_dim=width)
    skill = Skill(adapted=adapted, prior=prior, task=config.task, policy=config.policy)
    policy = TokenPolicy(adapted, prior.tokenizer, task.layout, config.policy)
    asked = torch.from_numpy(env.reset()[:, task.layout["task"]])
    adapted.observe(asked)
    if "sft" in config.methods:
        where = out / "sft" if "rl" in config.methods else out

        def save(metrics: dict[str, float]) -> None:
            skill.save_pretrained(where, base=base, card=skill_card(skill, config, seed, clips, metrics))

        supervise(
            adapted,
            prior.tokenizer,
            clips,
            asked,
            config.sft,
            where,
            save=save,
            seed=seed,
            threads=threads,
            quiet=quiet,
        )
    if "rl" in config.methods:
        _reinforce(skill, policy, env, config, out, base=base, clips=clips, seed=seed, threads=threads, quiet=quiet)
    return skill


def _reinforce(
    skill: Skill, policy: TokenPolicy, env: Env, config: FinetuneConfig, out: Path, *, base, clips, seed, threads, quiet
) -> None:
    critic = Critic(env.obs_size, config.critic)
    identity = {
        "stage": to_dict(config),
        "prior": fingerprint(skill.prior.gpt),
        "tokenizer": skill.prior.tokenizer.hash,
        "clips": [clip.name for clip in clips],
        "seed": seed,
    }
    run = Training(
        out=out,
        world=env,
        policy=policy,
        critic=critic,
        config=config.ppo,
        modules={"adapted": skill.adapted},
        identity=identity,
        kinds={"stage": FinetuneConfig},
        seed=seed,
    )

    def evaluate() -> TaskScore:
        controller = policy.controller(torch.Generator().manual_seed(seed + 1))
        played = play(
            controller,
            config.task,
            skill.prior,
            episodes=config.eval_episodes,
            seconds=config.eval_seconds,
            push=0.0,
            seed=seed + 1,
            threads=threads,
        )
        return played.score

    def keep(score: TaskScore) -> None:
        skill.save_pretrained(out, base=base, card=skill_card(skill, config, seed, clips, score.measures))

    run.train(
        samples=config.samples,
        eval_every=config.eval_every,
        evaluate=evaluate,
        keep=keep,
        critic_warmup=config.critic_warmup,
        title=f"finetune {config.task.kind}",
        quiet=quiet,
    )
    skill.adapted.load_adapter_state_(load_artifact(out, "adapter", ADAPTER).tensors)


def skill_card(skill: Skill, config: FinetuneConfig, seed: int, clips: Sequence[Clip], measures: dict[str, Any]) -> str:
    """The model card: use, training, results and limits."""
    trainable, base, share = parameters_of(skill.adapted)
    numbers = "\n".join(f"| {name} | {value:.3f} |" for name, value in measures.items() if isinstance(value, float))
    examples = f" Example clips: {', '.join(clip.name for clip in clips)}." if clips else ""
    return f"""# Skill `{config.task.kind}`: a {config.adapter.kind} adapter of a motion prior

    kinetok sample --adapter PATH --out skill.mp4
    kinetok evaluate task --adapter PATH --json task.json

- Task: `{to_dict(config.task)}`
- Adapter: {trainable:,} parameters beside {base:,} frozen ones ({share:.1%}); `{to_dict(config.adapter)}`
- Tokens are drawn from the adapted distribution within the frozen prior's nucleus: `{to_dict(config.policy)}`
- Training: {" -> ".join(config.methods)}; {config.samples:,} control steps at most of reinforcement learning.
  Seed {seed}.{examples}

## Last good evaluation, {config.eval_episodes} episodes of {config.eval_seconds:g} s

| measure | value |
|---|---|
{numbers}

Limits: flat floor; the prior it bends, and no other. Licence: Apache-2.0.
"""
