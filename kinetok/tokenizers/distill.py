"""Online distillation: the student acts, the teacher labels (DAgger, Ross et al. 2011; Hybrid sec. 4).

    score = distill(student, teachers, table, DistillStage(), out, seed=0)

The student (a tokenizer with its bottleneck) drives the worlds, so the states are the ones it will meet; each
state is labelled with the PD targets of its clip's teacher, and the student regresses on a window of the latest
labelled states. One student may learn from many teachers: `teachers[k]` labels clip k. Pushes, noisy starts and
episodes that end early keep the states as varied as the teachers can handle.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from kinetok.config import at_least, below
from kinetok.logger import Logger
from kinetok.resume import State
from kinetok.rl import ranks
from kinetok.rl.average import AVERAGED, Average
from kinetok.rl.rollout import seeded, torch_threads
from kinetok.rl.training import JUDGE
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.reset import ClipWeights
from kinetok.sim.tasks.roaming import REACH, Roaming
from kinetok.sim.tasks.tracking import Failure, ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers.symmetry import Mirror
from kinetok.tokenizers.tokenizer import MotionTokenizer
from kinetok.tokenizers.track import TrackingScore, track
from kinetok.tokenizers.train import COUNTS, KINDS, identify, in_scene, refuse_other_parents


@dataclass(frozen=True, kw_only=True)
class DistillStage:
    """samples: control steps of the student; rows: worlds; updates: minibatches of `minibatch` per control step;
    memory: labelled states kept; ema: factor of the average of the student's weights over control steps, which is then
    what is judged and kept (rl/average.py), 0 for the last ones themselves; keep: the artifact of the best evaluation
    or of the last; noise: radians added to the student's targets while it acts; failure: when its episodes end; focus:
    how many times as many states the clip that fails most may have as the one that fails least; from_start: share of
    the episodes that begin at their clip's first frame; transitions: changes of clip per second while it learns
    (sim.tasks.roaming), labelled by the new clip's teacher; reach_at_end: metres of roaming.likeness within which a
    motion goes on in another clip where its own ends; save_every: samples between states to resume from, at the next
    evaluation (the memory starts anew there, so not too often).

    A clip that its own teacher cannot follow fails for ever, and takes its share for nothing: of K clips, one such
    leaves (K - 1) / (K - 1 + focus) of the states to the others: of 20 clips 5/6 with a focus of 4."""

    samples: int = 200_000
    rows: int = 256
    updates: int = 2
    minibatch: int = 1024
    memory: int = 131_072
    lr: float = 1e-3
    lr_end: float = 1e-4
    ema: float = 0.0
    keep: Literal["best", "last"] = "best"
    noise: float = 0.02
    failure: Failure = Failure()
    focus: float = 4.0
    from_start: float = 0.0
    transitions: float = 0.0
    reach_at_end: float = REACH
    eval_every: int = 50_000
    eval_episodes: int = 16
    save_every: int = 400_000
    bf16: bool = False
    env: EnvConfig = EnvConfig(reset_noise=0.01)

    def __post_init__(self) -> None:
        at_least(self, 1, COUNTS | {
            "updates": "without minibatches nothing is learned",
            "minibatch": "without states nothing is learned",
            "focus": "1 draws all clips alike",
            "save_every": "give as many as samples for a single state at the end",
        })  # fmt: skip
        at_least(self, self.rows, {"memory": "every step's states go there, one of each of the rows"})
        at_least(self, 0, dict.fromkeys(("noise", "lr", "lr_end", "ema"), "0 is none"))
        below(self, 1, AVERAGED)


def distill(
    student: MotionTokenizer,
    teachers: Sequence[MotionTokenizer],
    table: ReferenceTable,
    config: DistillStage,
    out: Path,
    *,
    seed: int = 0,
    threads: int = 0,
    card: Callable[[TrackingScore], str] = lambda score: "",
    mirrored: Sequence[bool] = (),
    parents: dict[str, str] | None = None,
    quiet: bool = False,
) -> TrackingScore:
    """Train `student` in place; returns the score of the best artifact, which lies in `out`.

    mirrored: which clips are the mirror images of what their teacher knows; empty for none. parents: the teachers'
    hashes, kept in the artifact; a state that had others is refused.
    """
    ranks.alone("distillation")
    if len(teachers) != len(table.names):
        raise ValueError(f"{len(table.names)} clips need a teacher each (the same one may repeat), not {len(teachers)}")
    future, scene = student.config.future, student.config.scene
    seen_by_any = {frame for one in (student, *teachers) for frame in one.config.future}
    tracking = TrackingConfig(future=tuple(sorted(seen_by_any)), failure=config.failure, from_start=config.from_start)
    task = Tracking(tracking, table, rows=config.rows)
    if config.transitions:
        rng, rate = np.random.default_rng([seed, 1]), config.transitions
        task = Roaming(tracking, table, rows=config.rows, transitions=rate, rng=rng, reach_at_end=config.reach_at_end)
    task.weights = ClipWeights(len(table.names), bounds=(config.focus**-0.5, config.focus**0.5))
    env = Env(in_scene(config.env, scene), task, rows=config.rows, threads=threads, seed=seed)
    flags = mirrored or [False] * len(teachers)
    views = _Views([_View(teacher.eval(), task, flag) for teacher, flag in zip(teachers, flags, strict=True)])
    learner = _View(student, task, False)
    generator = seeded(seed)
    optimizer = torch.optim.Adam(student.parameters(), lr=config.lr, fused=True)
    identity = identify(config, student.config, table.identity, seed) | ({"parents": parents} if parents else {})
    average = Average(student.parameters(), config.ema) if config.ema else None
    parts = {"student": student, "optimizer": optimizer, "generator": generator}
    parts |= {"average": average} if average else {}
    state = State(out, parts, identity=identity, kinds=KINDS | {"stage": DistillStage})
    refuse_other_parents(state.path, parents or {})
    step = evaluated = saved = 0
    best: TrackingScore | None = None
    memory = torch.empty(config.memory, env.obs_size)
    labels = torch.empty(config.memory, env.action_size)
    if before := state.restore():
        meta = before[0]
        env.load_state_dict(json.loads(meta["env"]))
        step, best = meta["step"], meta.get("score") and TrackingScore.from_json(meta["score"])
        evaluated = saved = step * config.rows

    def judge() -> TrackingScore:
        episodes = config.eval_episodes
        return track(student, table, future=future, scene=scene, episodes=episodes, threads=threads, seed=seed + JUDGE)

    # The memory is filled anew after every save, so that a resumed run and an unbroken one are the same.
    filled = cursor = 0
    total = max(config.samples // config.rows, 1)
    start = (step + 1) * config.rows
    with Logger(out, total=config.samples, title="distill", start=start, stride=config.rows, quiet=quiet) as log:
        obs = torch.as_tensor(env.reset(spread=True))
        while step < total:
            with torch.no_grad(), torch_threads(1):
                action = learner.act(obs)
                target = views.label(obs, task.clip)
                rows = torch.arange(cursor, cursor + config.rows) % config.memory
                memory[rows], labels[rows] = obs, target
                cursor, filled = cursor + config.rows, min(filled + config.rows, config.memory)
                if float(student.norm.count) < 1_000_000:
                    student.observe(learner.seen(obs))
                action += config.noise * torch.randn(action.shape, generator=generator)
                seen = env.step(action.numpy(force=True)).obs
                if isinstance(task, Roaming):
                    task.land(env, seen)
                obs = torch.as_tensor(seen)
            for group in optimizer.param_groups:
                group["lr"] = config.lr + (config.lr_end - config.lr) * step / total
            loss = torch.zeros(())
            for _ in range(config.updates):
                ids = torch.randint(filled, (config.minibatch,), generator=generator)
                loss = _regress(student, optimizer, learner.seen(memory[ids]), labels[ids], bf16=config.bf16)
            if average:
                average.follow()
            step += 1
            samples = step * config.rows
            metrics = {"label_rmse": float(loss) ** 0.5} if step % 20 == 0 else {}
            due = samples - evaluated >= config.eval_every or step == total
            if due:
                evaluated = samples
                with average.standing_in() if average else nullcontext():
                    score = judge()
                    if best is None or score.merit > best.merit or config.keep == "last":
                        best = score
                        student.save_pretrained(out, card(score), parents)
                metrics |= {f"track/{k}": v for k, v in score.summary().items()} | env.episode_metrics()
            if metrics:
                log.write(samples, metrics)
            # Only right after an evaluation, from where its schedule and the episodes' sums start anew.
            if due and (samples - saved >= config.save_every or step == total):
                saved = samples
                told = {"step": step, "score": best and best.to_json(), "env": json.dumps(env.state_dict())}
                state.save(told)
                obs = torch.as_tensor(env.reset(spread=True))
                filled = cursor = 0
    student.load_state_dict(MotionTokenizer.from_pretrained(out).state_dict())
    return best or judge()


class _View:
    """A tokenizer that sees its own future window among the task's, and the world as it is or through a mirror."""

    def __init__(self, tokenizer: MotionTokenizer, task: Tracking, mirrored: bool):
        window, count = task.layout["window"], len(task.config.future)
        columns = torch.arange(window.start, window.stop).view(count, -1)
        picked = columns[[task.config.future.index(f) for f in tokenizer.config.future]].flatten()
        before, after = torch.arange(window.start), torch.arange(window.stop, task.obs_size)
        self.tokenizer, self._columns = tokenizer, torch.cat([before, picked, after])
        self._whole = torch.equal(self._columns, torch.arange(task.obs_size))
        self.mirror = Mirror.of(tokenizer.config.character, tokenizer.config.future) if mirrored else None

    def seen(self, obs: Tensor) -> Tensor:
        """The tokenizer's own observation (N, O) of the task's."""
        return obs if self._whole else obs[:, self._columns]

    def act(self, obs: Tensor) -> Tensor:
        own = self.seen(obs)
        if self.mirror is None:
            return self.tokenizer.act(own)[0]
        return self.mirror.action(self.tokenizer.act(self.mirror.observation(own))[0])


class _Views:
    """Every clip's view of its teacher; clips that share a teacher, seen alike, are labelled together."""

    def __init__(self, views: Sequence[_View]):
        kinds = [(id(view.tokenizer), view.mirror is None) for view in views]
        self._different = [views[kinds.index(kind)] for kind in dict.fromkeys(kinds)]
        self._of_clip = torch.tensor([list(dict.fromkeys(kinds)).index(kind) for kind in kinds])

    def label(self, obs: Tensor, clip: np.ndarray) -> Tensor:
        """PD targets (N, nu) for observations (N, O) of rows that follow the clips (N,)."""
        owner = self._of_clip[torch.as_tensor(clip)]
        acted = [(ids, view.act(obs[ids])) for k, view in enumerate(self._different)
                 if len(ids := torch.nonzero(owner == k).flatten())]  # fmt: skip
        target = torch.empty(len(obs), acted[0][1].shape[1])
        for ids, action in acted:
            target[ids] = action
        return target


def _regress(
    student: MotionTokenizer, optimizer: torch.optim.Optimizer, obs: Tensor, target: Tensor, *, bf16: bool
) -> Tensor:
    with torch.autocast(obs.device.type, torch.bfloat16, enabled=bf16):
        mean, auxiliary, _ = student.act(obs)
    loss = (mean.float() - target).pow(2).mean()
    if not torch.isfinite(loss):
        raise FloatingPointError(f"distillation loss is {loss.item()}; the last good state is kept")
    optimizer.zero_grad(set_to_none=True)
    (loss + auxiliary).backward()
    optimizer.step()
    return loss.detach()
