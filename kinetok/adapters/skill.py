"""What fine-tuning makes: an adapter, the prior it bends and the task it was bent to.

    skill = Skill.from_pretrained("humanoid-target")
    played = play(skill.controller(seed=0), skill.task, skill.prior, episodes=256)

Its artifact holds the adapter alone; the prior stays an artifact of its own, found by the place noted and refused
unless it is the one. What training began with is noted too, as its parent "skill".
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from kinetok.adapters.adapted import Adapted, fingerprint, parameters_of
from kinetok.adapters.rlft import Controller, TokenPolicy, TokenPolicyConfig
from kinetok.checkpoint import ADAPTER, CheckpointError, load_artifact, locate
from kinetok.config import ConfigError, diff, from_dict, pick, to_dict
from kinetok.gpt.controller import Prior, noted_path
from kinetok.rl.rollout import seeded
from kinetok.sim.tasks import TASKS, GoalConfig


@dataclass(frozen=True, kw_only=True, eq=False)
class Skill:
    """adapted: the bent prior, in eval mode; prior; base: where that lies, its directory or packaged name; task: what
    it was bent to; policy: how its tokens are drawn."""

    adapted: Adapted
    prior: Prior
    base: str
    task: GoalConfig
    policy: TokenPolicyConfig

    def controller(self, seed: int | None = 0) -> Controller:
        """Observations of the task to PD targets; seed None takes the most probable tokens."""
        generator = None if seed is None else seeded(seed)
        return TokenPolicy(self.adapted, self.prior.tokenizer, self.policy).controller(generator)

    def save_pretrained(self, path: Path | str, card: str | None = None, parents: dict[str, str] | None = None) -> None:
        """Write the adapter's directory. parents: role -> hash of what it was made from besides the prior."""
        noted = noted_path(self.base, path)
        skill = {"prior": noted, "task": to_dict(self.task), "policy": to_dict(self.policy)}
        self.adapted.save_pretrained(path, base=noted, card=card, skill=skill, parents=parents)

    @staticmethod
    def from_pretrained(
        path: Path | str,
        prior: Prior | Path | str | None = None,
        tokenizer: Path | str | None = None,
        *,
        rebase: bool = False,
    ) -> "Skill":
        """Load an adapter by directory or packaged name, with its prior: `prior`, itself or its directory, if given,
        else the one at the noted place. tokenizer: directory of the prior's, if it is not where the prior says. rebase:
        whether `prior` may be another than the one it was trained with."""
        artifact = load_artifact(path, "adapter", ADAPTER)
        noted = artifact.config["skill"]
        if noted is None:
            raise CheckpointError(f"{artifact.path} is an adapter that says nothing of a task; it cannot be played")
        base = "the prior given"
        if not isinstance(prior, Prior):
            base = _find(artifact.path, noted["prior"]) if prior is None else str(prior)
            prior = Prior.from_pretrained(base, tokenizer)
        return Skill(
            adapted=Adapted.from_pretrained(artifact.path, prior.gpt, base=base, rebase=rebase),
            prior=prior,
            base=base,
            task=from_dict(pick(TASKS, noted["task"]["kind"], "task")[0], noted["task"]),
            policy=from_dict(TokenPolicyConfig, noted["policy"]),
        )


def mean_of(skills: Sequence[Skill]) -> Skill:
    """A skill whose adapter's tensors are the mean of those of several checkpoints of one run.

    Steadier than each of them, the more so the further apart they lie (docs/log.md, "The average of a wandering
    policy"). Of adapters of different runs the mean is nothing; of different shapes or priors it is refused.
    """
    first, *others = skills
    for other in others:
        changed = diff(to_dict(first.adapted.config), to_dict(other.adapted.config))
        if changed or fingerprint(first.prior.gpt) != fingerprint(other.prior.gpt):
            raise ConfigError(f"these adapters differ: {'; '.join(changed) or 'they are of different priors'}")
    states = [skill.adapted.adapter_state() for skill in skills]
    mean = {name: torch.stack([state[name].double() for state in states]).mean(0) for name in states[0]}
    adapted = copy.deepcopy(first.adapted)
    adapted.load_adapter_state_({name: tensor.to(states[0][name].dtype) for name, tensor in mean.items()})
    return replace(first, adapted=adapted)


def _find(adapter: Path, noted: str) -> str:
    """The prior that the adapter in this directory notes: its directory, or its packaged name."""
    if (adapter / noted).is_dir():
        return str(adapter / noted)
    if not locate(noted).is_dir():
        raise CheckpointError(f"{adapter}: its prior is not at {noted!r}; give its place, --prior DIR")
    return noted


def skill_card(skill: Skill, story: str, seed: int, found: str, measures: dict) -> str:
    """The model card: use, training, results and limits. found: what the measures are of."""
    count, frozen, share = parameters_of(skill.adapted)
    rows = "\n".join(f"| {name} | {value:.3f} |" for name, value in measures.items() if isinstance(value, float))
    config = skill.adapted.config
    return f"""# Skill `{skill.task.kind}`: a {config.kind} adapter of a motion prior

    kinetok sample --adapter PATH --out skill.mp4
    kinetok evaluate task --adapter PATH --json task.json

- Task: `{to_dict(skill.task)}`
- Adapter: {count:,} parameters beside {frozen:,} frozen ones ({share:.1%}); `{to_dict(config)}`
- Tokens are drawn from the adapted distribution within the frozen prior's nucleus: `{to_dict(skill.policy)}`
- Training: {story}. Seed {seed}.

## {found}

| measure | value |
|---|---|
{rows}

Limits: flat floor; the prior it bends, and no other. Licence: Apache-2.0.
"""
