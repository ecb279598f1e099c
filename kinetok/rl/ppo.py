"""Proximal policy optimisation (Schulman et al. 2017) of a Gaussian policy with a scheduled spread.

    optimizers = Optimizers(actor, critic, config)
    metrics = update(actor, critic, optimizers, rollout, advantages, targets, config, log_std=-2.6, generator=g)

The actor's learning rate follows the measured KL divergence (halfway between the rules of Schulman's adaptive
KL and rsl_rl): it shrinks when a minibatch moves the policy further than twice `target_kl`, and grows below
half of it. An actor's auxiliary loss (a quantizer's) is added as it is. `anchor` pulls the policy towards the
means of a frozen one, in units of the noise.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from kinetok.rl.nets import Actor, Critic
from kinetok.rl.rollout import Rollout


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """horizon: steps per rollout; log_std: spread at the first and at the last iteration; lr: starting rate of the
    actor, lr_max: its ceiling; target_kl: the divergence per update it aims at."""

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
    log_std: tuple[float, float] = (-2.6, -2.9)
    max_grad_norm: float = 1.0
    anchor: float = 0.0


class Optimizers:
    """Adam for the actor and for the critic, and the actor's adaptive rate."""

    def __init__(self, actor: nn.Module, critic: nn.Module, config: PPOConfig):
        fused = next(actor.parameters()).device.type == "cpu"
        self.actor = torch.optim.Adam(actor.parameters(), lr=config.lr, fused=fused)
        self.critic = torch.optim.Adam(critic.parameters(), lr=config.critic_lr, fused=fused)
        self.range = (1e-5, config.lr_max)

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
    actor: Actor,
    critic: Critic,
    optimizers: Optimizers,
    rollout: Rollout,
    advantages: Tensor,
    targets: Tensor,
    config: PPOConfig,
    *,
    log_std: float,
    generator: torch.Generator,
    train_actor: bool = True,
    anchor: Actor | None = None,
) -> dict[str, float]:
    """`epochs` passes of minibatch steps over a rollout; returns means of the losses and diagnostics.

    Raises FloatingPointError before any parameter moves by a loss that is not finite.
    """
    obs, actions, means = (x.flatten(0, 1) for x in (rollout.obs, rollout.actions, rollout.means))
    precision = float(torch.exp(torch.tensor(-2.0 * log_std)))
    advantages, targets = advantages.flatten(), targets.flatten()
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-6)
    old_log_prob = -0.5 * precision * ((actions - means) ** 2).sum(-1)
    sums: dict[str, Tensor] = {}
    steps = 0
    for _ in range(config.epochs):
        for ids in torch.randperm(len(obs), generator=generator).split(config.minibatch):
            batch = obs[ids]
            value_loss = (critic(batch) - targets[ids]).pow(2).mean()
            metrics: dict[str, Tensor] = {"value_loss": value_loss}
            loss = value_loss
            if train_actor:
                mean, auxiliary, extra = actor.act(batch)
                log_prob = -0.5 * precision * ((actions[ids] - mean) ** 2).sum(-1)
                policy_loss = surrogate(log_prob - old_log_prob[ids], advantages[ids], config.clip)
                kl = 0.5 * precision * (mean.detach() - means[ids]).pow(2).sum(-1).mean()
                loss = loss + policy_loss + auxiliary
                metrics |= {"policy_loss": policy_loss, "kl": kl, **extra}
                if anchor is not None and config.anchor:
                    with torch.no_grad():
                        target = anchor.act(batch)[0]
                    pull = 0.5 * precision * (mean - target).pow(2).sum(-1).mean()
                    loss = loss + config.anchor * pull
                    metrics["anchor"] = pull
            if not torch.isfinite(loss):
                raise FloatingPointError(f"loss is {loss.item()}")
            optimizers.actor.zero_grad(set_to_none=True)
            optimizers.critic.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(critic.parameters(), config.max_grad_norm)
            optimizers.critic.step()
            if train_actor:
                nn.utils.clip_grad_norm_(actor.parameters(), config.max_grad_norm)
                optimizers.actor.step()
                optimizers.adapt(float(metrics["kl"]), config.target_kl)
            for name, value in metrics.items():
                sums[name] = sums.get(name, torch.zeros(())) + value.detach()
            steps += 1
    return {name: float(total) / steps for name, total in sums.items()} | {"lr": optimizers.lr}
