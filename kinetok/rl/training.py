"""One PPO training from its first rollout to its best artifact; the same loop for every policy and task.

    run = Training(out=out, world=env, policy=policy, critic=critic, config=PPOConfig(), modules={"actor": actor},
                   identity=identity, seed=0)
    progress = run.train(samples=1_000_000, eval_every=100_000, evaluate=evaluate, keep=keep)

`out` receives metrics.jsonl and state.safetensors: a later call with the same identity goes on bit for bit where
that state was written. The first rollout of a fresh policy only sets the normalisers. A reward, an observation or a
loss that is not finite stops the run, keeps the last good state and dumps the offending rollout. Several processes may
train together (ranks.py); `world` is then this one's share.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import torch

from kinetok.checkpoint import CheckpointError, save_state
from kinetok.logger import Logger
from kinetok.resume import Part, State
from kinetok.rl import ranks
from kinetok.rl.average import Average
from kinetok.rl.nets import Critic
from kinetok.rl.policy import Policy
from kinetok.rl.ppo import Optimizers, PPOConfig, update
from kinetok.rl.returns import gae
from kinetok.rl.rollout import Rollout, World, collect, seeded

JUDGE = 1_000_000  # added to the seed of a run: the episodes that choose its best are not those of an `evaluate`


class Score(Protocol):
    """What an evaluation found: merit orders artifacts, summary is logged, to_json survives a resumption."""

    @property
    def merit(self) -> float: ...
    def summary(self) -> dict[str, float]: ...
    def to_json(self) -> dict: ...


S = TypeVar("S", bound=Score)


@dataclass
class Progress:
    """What a run knows of itself besides its tensors. best, score: merit and to_json() of what was kept; stale:
    evaluations since; evaluated, saved: samples at the last evaluation and at the last save."""

    iteration: int = 0
    samples: int = 0
    evaluated: int = 0
    saved: int = 0
    best: float = -1e9
    stale: int = 0
    score: dict | None = None


class Training:
    """The mutable parts of one training, saved and restored together. modules: what is trained, besides the critic, by
    its name in the state; identity: what a run must share with another to go on from it (JSON); kinds: classes of the
    configs in it; average: of the policy's weights, which is then what is judged and kept."""

    def __init__(
        self,
        *,
        out: Path,
        world: World,
        policy: Policy,
        critic: Critic,
        config: PPOConfig,
        modules: Mapping[str, Part],
        identity: dict[str, Any],
        kinds: Mapping[str, type],
        seed: int,
        average: Average | None = None,
    ):
        self.average = average
        self.out, self.world, self.policy, self.critic, self.config = out, world, policy, critic, config
        self.optimizers = Optimizers(policy, critic, config)
        self.generator = seeded(ranks.own(seed))
        parts = {"critic": critic, **modules, "optimizers": self.optimizers, "generator": self.generator}
        parts |= {"average": average} if average else {}
        identity = identity | ({"ranks": ranks.size()} if ranks.size() > 1 else {})
        self._state = State(out, parts, identity=identity, kinds=kinds, name=ranks.named("state"))

    def train(
        self,
        *,
        samples: int,
        eval_every: int,
        evaluate: Callable[[], S],
        keep: Callable[[S], None],
        finished: Callable[[Progress], bool] = lambda progress: False,
        schedule: Callable[[float], None] = lambda share: None,
        save_every: int = 0,
        critic_warmup: int = 0,
        warm: bool = False,
        latest: bool = False,
        title: str = "ppo",
        prefix: str = "eval",
        quiet: bool = False,
    ) -> Progress:
        """Train until `samples` control steps are done or `finished` says so.

        keep: writes the artifact, called with each score that is the best so far, or with every one when only the
        `latest` is to stay. schedule: told the share done before each rollout. save_every: samples from a save to the
        evaluation that is followed by the next, 0 for every one; after a save the worlds begin anew, so not too often.
        critic_warmup: first iterations that leave the policy alone. warm: the policy's normalisers come from an
        earlier training and stay as they are: moved, they undo what its weights, which know no others, can do
        (docs/log.md, "What a normaliser forgets").
        """
        progress = self.resume()
        per_iteration = self.world.rows * self.config.horizon * ranks.size()
        quiet, files = quiet or ranks.rank() > 0, None if ranks.rank() else self.out
        start = progress.samples + per_iteration
        with Logger(files, total=samples, title=title, start=start, stride=per_iteration, quiet=quiet) as log:
            obs = torch.as_tensor(self.world.reset(spread=True))
            while progress.samples < samples and not finished(progress):
                done = min(progress.samples / samples, 1.0)
                schedule(done)
                rollout = collect(
                    self.world, self.policy, self.critic, obs, horizon=self.config.horizon, generator=self.generator
                )
                obs = rollout.last_obs
                first = progress.iteration == 0
                with self._stopping(rollout):
                    train_actor = progress.iteration > critic_warmup
                    metrics = {} if first else self.learn(rollout, done, train_actor=train_actor)
                    if not warm:
                        self.policy.observe(rollout.obs)
                    self.critic.observe(rollout.obs)
                if self.average and train_actor:
                    self.average.follow()
                progress.iteration += 1
                progress.samples += per_iteration
                due = progress.samples >= min(progress.evaluated + eval_every, samples)
                if due:
                    progress.evaluated = progress.samples
                    with self.average.standing_in() if self.average else nullcontext():
                        score = ranks.first(evaluate)
                        progress.stale += 1
                        if better := score.merit > progress.best:
                            progress.best, progress.stale = score.merit, 0
                        if better or latest:
                            progress.score = score.to_json()
                            ranks.first(partial(keep, score))
                    metrics |= {f"{prefix}/{name}": value for name, value in score.summary().items()}
                metrics["reward"] = float(rollout.rewards.mean())  # a step; episodes' sums are of whole episodes alone
                log.write(progress.samples, metrics | self.world.episode_metrics())
                if due and (progress.samples - progress.saved >= save_every or progress.samples >= samples):
                    progress.saved = progress.samples
                    self.save(progress)
                    obs = torch.as_tensor(self.world.reset(spread=True))
        return progress

    def learn(self, rollout: Rollout, done: float, *, train_actor: bool = True) -> dict[str, float]:
        """One PPO update when a share of the training is done; FloatingPointError when anything is not finite."""
        config = self.config
        advantages, targets = gae(
            rollout.rewards, rollout.values, rollout.next_values, rollout.done, config.gamma, config.lam
        )
        metrics = update(
            self.policy,
            self.critic,
            self.optimizers,
            rollout,
            advantages,
            targets,
            config,
            generator=self.generator,
            train_actor=train_actor,
            done=done,
        )
        # The last minibatch's gradient has no later loss that would show it.
        finite = [torch.isfinite(p).all() for p in (*self.optimizers.parameters, *self.critic.parameters())]
        if not (np.isfinite(list(metrics.values())).all() and torch.stack(finite).all()):
            raise FloatingPointError(f"parameters or metrics are not finite: {metrics}")
        return metrics | {"failed_simulations": self.world.failed_simulations}

    @contextmanager
    def _stopping(self, rollout: Rollout) -> Iterator[None]:
        """Refuse a rollout that is not finite; dump it where what is done with it is not, and say what is left."""
        try:
            bad = ~torch.isfinite(rollout.rewards)
            if bad.any():
                raise FloatingPointError(f"{int(bad.sum())} of {bad.numel()} rewards are not finite")
            yield
        except FloatingPointError as error:
            dump = self.out / f"{ranks.named('bad_rollout')}.safetensors"
            save_state(dump, {"obs": rollout.obs, "rewards": rollout.rewards, **rollout.taken}, {})
            left = (
                f"the last good state in {self._state.path} is untouched"
                if self._state.path.exists()
                else "nothing was saved yet"
            )
            raise FloatingPointError(
                f"{error}; training stopped. The rollout is in {dump}; {left}. "
                "Try a smaller rate (--set ppo.lr, of a stage teacher.ppo.lr), or see the clip by `kinetok clips info`"
            ) from error

    def save(self, progress: Progress) -> None:
        """Write the state, from which `resume` goes on."""
        self._state.save({"progress": vars(progress), "env": json.dumps(self.world.state_dict())})

    def resume(self) -> Progress:
        """Take up the state in `out`; a fresh Progress where there is none. CheckpointError if it is another run's."""
        before = self._state.restore()
        progress = Progress(**before[0]["progress"]) if before else Progress()
        samples = ranks.gathered(torch.tensor([progress.samples])).tolist()
        if len(set(samples)) > 1:
            raise CheckpointError(
                f"the states in {self.out}, one of each process, are of {' and '.join(map(str, samples))} samples: "
                "they were not saved together; remove them to begin anew"
            )
        if before:
            self.world.load_state_dict(json.loads(before[0]["env"]))
        return progress
