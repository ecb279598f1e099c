"""Reinforcement learning fine-tuning: PPO over the tokens of a control step (GPC sec. 7.2, app. D).

    policy = TokenPolicy(adapted, prior.tokenizer, TokenPolicyConfig())
    played = play(policy.controller(generator), task_config, prior, episodes=64)

An action is the S tokens of a step; its log-probability is the sum over them, its advantage one for all. The
frozen prior's nucleus bounds what may be drawn (policy.py). Observations are state | task, as the tasks lay them
out (sim.tasks.upright). `play` measures any controller on a task: a fine-tuned prior, the prior alone, a network
that knows no tokens.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kinetok.adapters.adapted import Adapted
from kinetok.adapters.policy import draw, new_caches, score, uniforms
from kinetok.config import ConfigError
from kinetok.gpt.controller import Prior
from kinetok.gpt.data import Starts
from kinetok.gpt.replay import Replay
from kinetok.rl.policy import Assessment
from kinetok.rl.rollout import torch_threads
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks import Goal, GoalConfig, Marker, Scorecard, build_task
from kinetok.tokenizers.tokenizer import MotionTokenizer

Controller = Callable[[Tensor], Tensor]  # observations (N, O) -> PD targets (N, nu)


@dataclass(frozen=True, kw_only=True)
class TokenPolicyConfig:
    """top_p: mass of the frozen prior's nucleus, 1 for no bound; least: options that it has at least: what a prior that
    is sure of itself does now and then, such as to set out from a stand, stays possible; temperature: divides the
    logits (GPC table 12); kl: weight of the divergence from the prior in the loss, nats a step; entropy: weight of the
    bonus (NCP: top_p 1, kl 0.05, entropy 0.01); guidance: how many times as far as the adapter says its logits go from
    the prior's."""

    top_p: float = 0.9
    least: int = 1
    temperature: float = 1.0
    kl: float = 0.0
    entropy: float = 0.0
    guidance: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.top_p <= 1.0:
            raise ConfigError(f"top_p must lie in (0, 1], not {self.top_p}; 1 keeps every token")
        if self.least < 1:
            raise ConfigError(f"least must be at least 1, not {self.least}: without an option there is nothing to draw")
        if not (self.temperature > 0.0 and self.kl >= 0.0 and self.entropy >= 0.0 and self.guidance >= 0.0):
            raise ConfigError(f"a temperature is above 0; kl, entropy and guidance are not below it: {self}")


class TokenPolicy:
    """What PPO trains (rl.policy.Policy): an adapted prior that draws tokens, and the frozen decoder that acts them.

    `anchor` is a frozen copy, towards whose distribution the policy is pulled with `pull` a nat and step."""

    def __init__(
        self,
        adapted: Adapted,
        tokenizer: MotionTokenizer,
        config: TokenPolicyConfig,
        anchor: Adapted | None = None,
        pull: float = 0.0,
    ):
        self.adapted, self.tokenizer, self.config = adapted, tokenizer, config
        self.anchor, self.pull = anchor, pull
        self.tokens, self.state_dim = tokenizer.layout, adapted.base.config.state_dim
        self._players: dict[tuple[int, bool], Callable[..., tuple[Tensor, ...]]] = {}

    def draw(self, obs: Tensor, generator: torch.Generator | None) -> tuple[Tensor, dict[str, Tensor]]:
        """PD targets (N, nu) and the tokens behind them; without a generator the most probable ones."""
        key = len(obs), generator is None
        if key not in self._players:
            self._players[key] = self._player(len(obs), replayed=obs.device.type == "cuda")
        given = () if generator is None else (uniforms(self.adapted, len(obs), generator),)
        tokens, keep, log_prob = self._players[key](obs, *given)
        action = self.tokenizer.decode(self.tokens.to_codes(tokens), obs[:, : self.state_dim])
        return action, {"tokens": tokens, "keep": keep, "log_prob": log_prob.sum(-1)}

    def _player(self, rows: int, *, replayed: bool) -> Callable[..., tuple[Tensor, ...]]:
        """tokens, keep, log_prob of observations (rows, O) and the numbers to draw by, if any."""
        config, caches = self.config, new_caches(self.adapted, rows)

        def play(obs: Tensor, uniform: Tensor | None = None) -> tuple[Tensor, ...]:
            return draw(
                self.adapted,
                *self._parts(obs),
                uniform,
                top_p=config.top_p,
                least=config.least,
                temperature=config.temperature,
                guidance=config.guidance,
                caches=caches,
            )

        return Replay(play) if replayed else play

    def assess(self, obs: Tensor, taken: dict[str, Tensor]) -> Assessment:
        config, (state, c) = self.config, self._parts(obs)
        found = score(
            self.adapted,
            state,
            c,
            taken["tokens"],
            taken["keep"],
            temperature=config.temperature,
            guidance=config.guidance,
            reference=config.kl > 0,
            anchor=self.anchor,
            bonus=config.entropy > 0,
        )
        entropy = found.entropy.mean()
        loss, metrics = -config.entropy * entropy, {"entropy": entropy.detach()}
        if found.kl is not None:
            loss, metrics = loss + config.kl * found.kl.mean(), metrics | {"kl_prior": found.kl.mean().detach()}
        if found.anchor is not None:
            loss, metrics = loss + self.pull * found.anchor.mean(), metrics | {"anchor": found.anchor.mean().detach()}
        # Schulman's low-variance estimate of KL(then || now), from what was drawn then.
        change = (found.log_prob - taken["log_prob"]).detach()
        return Assessment(log_prob=found.log_prob, kl=(change.exp() - 1 - change).mean(), loss=loss, metrics=metrics)

    def observe(self, obs: Tensor) -> None:
        self.adapted.observe(obs[..., self.state_dim :])

    def parameters(self) -> Iterable[nn.Parameter]:
        return self.adapted.trainable()

    def controller(self, generator: torch.Generator | None) -> Controller:
        """The policy as it is played; without a generator greedily."""
        return lambda obs: self.draw(obs, generator)[0]

    def _parts(self, obs: Tensor) -> tuple[Tensor, Tensor | None]:
        state, c = obs[:, : self.state_dim], obs[:, self.state_dim :]
        return state, c if self.adapted.cond_dim else None


@dataclass(frozen=True, kw_only=True)
class TaskScore:
    """measures: of a Scorecard. merit: the reward of a step, none while a row is down. The return, which ends with a
    row's first fall, prefers a skill that does nothing and never falls to one that does its task and gets up again."""

    measures: dict[str, Any]

    @property
    def merit(self) -> float:
        return self.measures["reward"]

    def summary(self) -> dict[str, float]:
        return {name: value for name, value in self.measures.items() if isinstance(value, float)}

    def to_json(self) -> dict:
        return {"measures": self.measures}


@dataclass(frozen=True, kw_only=True, eq=False)
class Played:
    """score, with head_height_m (mean, of the head's joint) where the character names its head; qpos (T, K, nq) of the
    first K = `record` rows, and markers (T lists) of the first row, in frames of `fps`."""

    score: TaskScore
    qpos: np.ndarray
    markers: list[list[Marker]]
    fps: int


def standing(starts: Starts, fall_height: float) -> tuple[np.ndarray, np.ndarray]:
    """qpos (K, nq), qvel (K, nv) of the start states whose root is above fall_height."""
    up = starts.qpos[:, 2] >= fall_height
    if not up.any():
        raise ValueError(f"none of the prior's {len(up)} start states has its root above fall_height {fall_height} m")
    return starts.qpos[up], starts.qvel[up]


def task_of(config: GoalConfig, prior: Prior, rows: int, starts: np.ndarray | None = None) -> Goal:
    """The task in the prior's body and at its rate, from its upright start states."""
    qpos, qvel = standing(prior.starts, config.fall_height)
    return build_task(config, prior.character, qpos, qvel, rows=rows, starts=starts, control_hz=prior.fps)


def play(
    controller: Controller,
    config: GoalConfig,
    prior: Prior,
    *,
    episodes: int = 64,
    seconds: float = 20.0,
    push: float = 0.0,
    push_seconds: float = 2.0,
    seed: int = 0,
    threads: int = 0,
    record: int = 0,
) -> Played:
    """Let `episodes` characters do the task for `seconds` without resets, and measure. record: rows to keep for a
    video. push: m/s added to the root's horizontal velocity every push_seconds. Same seed and controller, same
    result, at any number of threads."""
    steps = round(seconds * prior.fps)
    if steps < 1 or episodes < 1:
        raise ValueError(f"{episodes} episodes of {seconds:g} s hold no control step of 1/{prior.fps} s")
    task = task_of(config, prior, episodes)
    world = EnvConfig(
        scene=prior.tokenizer.config.scene,
        episode_seconds=seconds + 1,
        push=push,
        push_seconds=push_seconds,
        push_regular=True,
        autoreset=False,
    )
    env = Env(world, task, rows=episodes, threads=threads, seed=seed)
    card = Scorecard(rows=episodes, control_hz=prior.fps)
    heads = prior.character.bodies("head") if "head" in prior.character.roles else []
    obs = env.reset()
    qpos: list[np.ndarray] = []
    markers: list[list[Marker]] = []
    with torch.no_grad(), torch_threads(1):
        for _ in range(steps):
            if record:
                qpos.append(env.sim.qpos[:record].copy())
                markers.append(task.markers(0))
            step = env.step(controller(torch.as_tensor(obs)).numpy(force=True))
            body = env.sim.state()
            head = {"head_height_m": body.pos[:, heads[0], 2]} if heads else {}
            card.add(step.reward, step.terminated, step.failed, task.measure(body) | head)
            obs = step.obs
    frames = np.stack(qpos) if qpos else np.empty((0, 0, prior.character.nq))
    return Played(score=TaskScore(measures=card.summary()), qpos=frames, markers=markers, fps=prior.fps)
