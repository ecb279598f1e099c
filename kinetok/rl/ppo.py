"""Proximal policy optimisation (Schulman et al. 2017) of any policy that fits policy.py.

    optimizers = Optimizers(policy, critic, config)
    metrics = update(policy, critic, optimizers, rollout, advantages, targets, config, generator=g)

The policy's learning rate follows the measured KL divergence (halfway between the rules of Schulman's adaptive
KL and rsl_rl): it shrinks when a minibatch moves the policy further than twice `target_kl`, and grows below
half of it. What the policy adds as a loss of its own (a quantizer's, an anchor's, an entropy) is added as it is.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from kinetok.config import ConfigError
from kinetok.rl import ranks
from kinetok.rl.nets import Critic
from kinetok.rl.policy import Policy
from kinetok.rl.rollout import Rollout

LEAST_RATE = 1e-5  # of the policy, unless it begins with a lower one
CHUNK = 1024  # samples of a minibatch whose gradients are taken at a time: what a core's cache holds of a token policy


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """horizon: steps per rollout; lr: starting rate of the policy, lr_max: its ceiling; target_kl: the divergence per
    update it aims at, and at the last sample target_kl_end, 0 for the same all the time: large steps get there
    sooner, small ones come to rest there."""

    horizon: int = 16
    epochs: int = 3
    minibatch: int = 1024
    clip: float = 0.2
    gamma: float = 0.97
    lam: float = 0.95
    lr: float = 4e-4
    lr_max: float = 1e-3
    critic_lr: float = 1e-3
    target_kl: float = 0.03
    target_kl_end: float = 0.0
    max_grad_norm: float = 1.0

    def __post_init__(self) -> None:
        if not (self.target_kl > 0 and self.target_kl_end >= 0):
            raise ConfigError(
                f"target_kl is above 0 and target_kl_end not below it, 0 for the same; "
                f"not {self.target_kl} and {self.target_kl_end}"
            )

        if not 0 < self.lr <= self.lr_max:
            raise ConfigError(
                f"lr is above 0 and at most lr_max, {self.lr_max:g}, not {self.lr:g}; lower it or raise lr_max"
            )

    def aim(self, done: float) -> float:
        """The divergence aimed at when a share of the training is done: from one end to the other geometrically."""
        return self.target_kl * ((self.target_kl_end or self.target_kl) / self.target_kl) ** done


class Optimizers:
    """Adam for the policy ("actor") and for the critic, and the policy's adaptive rate."""

    def __init__(self, policy: Policy | nn.Module, critic: nn.Module, config: PPOConfig):
        self.parameters = [p for p in policy.parameters() if p.requires_grad]
        self.actor = torch.optim.Adam(self.parameters, lr=config.lr, fused=True)
        self.critic = torch.optim.Adam(critic.parameters(), lr=config.critic_lr, fused=True)
        self.range = (min(LEAST_RATE, config.lr), config.lr_max)

    @property
    def lr(self) -> float:
        return self.actor.param_groups[0]["lr"]

    def adapt(self, kl: float, target: float) -> None:
        """Move the actor's rate by 1.3 when the KL leaves [target / 2, 2 * target]."""
        factor = 1 / 1.3 if kl > 2 * target else 1.3 if kl < target / 2 else 1.0
        self.actor.param_groups[0]["lr"] = min(max(self.lr * factor, self.range[0]), self.range[1])

    def state_dict(self) -> dict:
        return {"actor": self.actor.state_dict(), "critic": self.critic.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])


def surrogate(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """PPO's clipped objective, negated: mean of -min(r A, clip(r) A)."""
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


def update(
    policy: Policy,
    critic: Critic,
    optimizers: Optimizers,
    rollout: Rollout,
    advantages: Tensor,
    targets: Tensor,
    config: PPOConfig,
    *,
    generator: torch.Generator,
    train_actor: bool = True,
    done: float = 0.0,
) -> dict[str, float]:
    """`epochs` passes of minibatch steps over a rollout, and those of the other ranks (ranks.py); returns means of the
    losses and diagnostics. done: the share of the training that is.

    Raises FloatingPointError before any parameter moves by a loss that is not finite.
    """
    obs, taken = rollout.obs.flatten(0, 1), {name: x.flatten(0, 1) for name, x in rollout.taken.items()}
    advantages, targets = advantages.flatten(), targets.flatten()
    everyone = ranks.gathered(advantages)
    advantages = (advantages - everyone.mean()) / (everyone.std() + 1e-6)
    weights = [*critic.parameters(), *(optimizers.parameters if train_actor else ())]
    size = ranks.share(config.minibatch, "ppo.minibatch")
    sums: dict[str, Tensor] = {}
    steps = 0
    for _ in range(config.epochs):
        for minibatch in torch.randperm(len(obs), generator=generator).split(size):
            optimizers.actor.zero_grad(set_to_none=True)
            optimizers.critic.zero_grad(set_to_none=True)
            means: dict[str, Tensor] = {}
            for ids in minibatch.split(CHUNK if obs.device.type == "cpu" else size):
                value_loss = (critic(obs[ids]) - targets[ids]).pow(2).mean()
                metrics: dict[str, Tensor] = {"value_loss": value_loss}
                loss = value_loss
                if train_actor:
                    judged = policy.assess(obs[ids], {name: x[ids] for name, x in taken.items()})
                    policy_loss = surrogate(judged.log_prob - taken["log_prob"][ids], advantages[ids], config.clip)
                    loss = loss + policy_loss + judged.loss
                    metrics |= {"policy_loss": policy_loss, "kl": judged.kl, **judged.metrics}
                if not torch.isfinite(loss):
                    raise FloatingPointError(f"loss is {loss.item()}")
                share = len(ids) / len(minibatch)
                (share * loss).backward()
                for name, value in metrics.items():
                    means[name] = means.get(name, torch.zeros(())) + share * value.detach()
            ranks.average_([weight.grad for weight in weights if weight.grad is not None])
            ranks.average_(means.values())
            nn.utils.clip_grad_norm_(critic.parameters(), config.max_grad_norm)
            optimizers.critic.step()
            if train_actor:
                nn.utils.clip_grad_norm_(optimizers.parameters, config.max_grad_norm)
                optimizers.actor.step()
                optimizers.adapt(float(means["kl"]), config.aim(done))
            for name, value in means.items():
                sums[name] = sums.get(name, torch.zeros(())) + value
            steps += 1
    return {name: float(total) / steps for name, total in sums.items()} | {"lr": optimizers.lr}
