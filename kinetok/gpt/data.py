"""What a prior learns from: the tokens a frozen tokenizer chose, and the states it chose them in.

    data = record(tokenizer, table, samples=400_000, rows=256, seed=0, threads=2, env=EnvConfig(push=0.5))
    data.save(out / "tokens.safetensors", {})
    data.states, data.tokens                       # (M, S) float32, (M, T) int32

GPC sec. 6 trains its prior on rollouts of the frozen tracker. The worlds are driven by decode(codes), never by
the reference, so the states are those the decoder itself produces; pushes and noisy starts put recoveries among
them. Clips are drawn half of the time each as often as any other, half of the time by their duration, whatever
the tracker fails at. The last second before a failure is left out.

The clips are joined into one endless motion (sim.tasks.roaming): a row changes to another clip at random
(`transitions` per second) and, wherever a like frame exists, before a clip ends, so that the prior learns what
follows an end, and how to change from one clip to another. Where a clip ends and no frame is like it, the motion may
go on in the likest frame further away (`reach_at_end`): the reference jumps, the body does not, and the tracker
pulls it over. What it does then is kept unless it fails.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kinetok.checkpoint import load_state, save_state
from kinetok.logger import Logger
from kinetok.rl.rollout import torch_threads
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.reset import ClipWeights
from kinetok.sim.tasks.matching import Matching
from kinetok.sim.tasks.roaming import REACH, Roaming
from kinetok.sim.tasks.tracking import ReferenceTable, TrackingConfig
from kinetok.tokenizers.tokenizer import MotionTokenizer
from kinetok.tokenizers.train import in_scene

BEFORE_FAILURE = 1.0  # seconds; more than roaming.GRACE, so that what a landing spoiled is left out
STARTS = 512


@dataclass(frozen=True, kw_only=True, eq=False)
class Starts:
    """States to begin from: qpos (K, nq), qvel (K, nv) float64; clip (K,): which clip each was taken from."""

    qpos: np.ndarray
    qvel: np.ndarray
    clip: np.ndarray

    def tensors(self, prefix: str = "starts.") -> dict[str, Tensor]:
        """Named tensors to save; `of` reads them back."""
        return {prefix + name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in vars(self).items()}

    @classmethod
    def of(cls, tensors: dict[str, Tensor], prefix: str = "starts.") -> "Starts":
        return cls(**{name: tensors[prefix + name].numpy(force=True) for name in ("qpos", "qvel", "clip")})


@dataclass(frozen=True, kw_only=True, eq=False)
class TokenDataset:
    """M control steps. states (M, S) float32; tokens (M, T) int32 chosen in them; clip (M,): index into names;
    world (M,): the simulation it was seen in; starts: reference states of the same clips."""

    states: Tensor = field(repr=False)
    tokens: Tensor = field(repr=False)
    clip: Tensor = field(repr=False)
    world: Tensor = field(repr=False)
    names: tuple[str, ...]
    starts: Starts = field(repr=False)

    def __len__(self) -> int:
        return len(self.states)

    def statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (S,) of the states."""
        std, mean = torch.std_mean(self.states.double(), dim=0, correction=0)
        return mean.float(), std.float()

    def split(self, share: float, most: int | None = None) -> tuple[Tensor, Tensor]:
        """Sample ids (M1,), (M2,) to learn from and to hold out: whole worlds, as neighbours in time are alike.

        most: of what is held out, so many spread evenly at most."""
        if not 0 <= share < 1:
            raise ValueError(f"the held-out share must lie in [0, 1), not {share}")
        worlds = self.world.unique()
        held = max(1, round(len(worlds) * share)) if share else 0
        if held >= len(worlds):
            raise ValueError(f"cannot hold out {held} of {len(worlds)} worlds; record with more rows")
        out = torch.isin(self.world, worlds[len(worlds) - held :])
        hold = torch.nonzero(out).flatten()
        if most and len(hold) > most:
            hold = hold[torch.linspace(0, len(hold) - 1, most).long()]
        return torch.nonzero(~out).flatten(), hold

    def save(self, path: Path, meta: dict[str, Any]) -> None:
        """Write one file; meta is JSON-able and comes back from `load`."""
        tensors = {name: getattr(self, name) for name in ("states", "tokens", "clip", "world")}
        save_state(path, tensors | self.starts.tensors(), {"names": list(self.names), "meta": meta})

    @classmethod
    def load(cls, path: Path) -> tuple["TokenDataset", dict[str, Any]]:
        """The data set and the meta that `save` wrote."""
        tensors, meta = load_state(path)
        parts = {name: tensors[name] for name in ("states", "tokens", "clip", "world")}
        return cls(**parts, names=tuple(meta["names"]), starts=Starts.of(tensors)), meta["meta"]


def clip_weights(table: ReferenceTable) -> np.ndarray:
    """How often each clip (K,) is drawn: half uniformly, half by duration; the sum is 1."""
    return 0.5 / len(table.names) + 0.5 * table.cycle / table.cycle.sum()


def draw_starts(table: ReferenceTable, count: int, rng: np.random.Generator) -> Starts:
    """`count` random frames of the clips' first cycles, clips drawn by `clip_weights`."""
    clip = rng.choice(len(table.names), size=count, p=clip_weights(table))
    frame = table.first[clip] + (rng.random(count) * table.cycle[clip]).astype(int)
    return Starts(qpos=table.qpos[frame], qvel=table.qvel[frame], clip=clip.astype(np.int64))


def jitter(codes: Tensor, share: float, levels: int, rng: np.random.Generator) -> Tensor:
    """Codes (N, D) of which a `share` is moved up or down by one level, within 0 .. levels - 1."""
    shift = np.where(rng.random(codes.shape) < share, rng.choice([-1, 1], codes.shape), 0)
    return (codes + torch.as_tensor(shift)).clamp(0, levels - 1)


def before_failure(terminated: np.ndarray, done: np.ndarray, steps: int) -> np.ndarray:
    """Which of (T, N) control steps are among the last `steps` of an episode that failed.

    terminated, done (T, N) bool: the step failed; the step was its episode's last for whatever reason.
    """
    doomed = terminated.copy()
    for _ in range(steps - 1):
        doomed[:-1] |= doomed[1:] & ~done[:-1]
    return doomed


@dataclass(frozen=True, kw_only=True, eq=False)
class Rollout:
    """T control steps of N worlds. states (T, N, S) float32; tokens (T, N, K) int32 chosen in them; root (T, N, 7):
    position and quaternion before the step; terminated: the step failed; cut: the path breaks off after the step, for
    a new episode or a new clip. clip (T, N): what was followed, -1 for nothing."""

    states: Tensor = field(repr=False)
    tokens: Tensor = field(repr=False)
    root: np.ndarray = field(repr=False)
    terminated: np.ndarray = field(repr=False)
    cut: np.ndarray = field(repr=False)
    clip: np.ndarray = field(repr=False)

    @staticmethod
    def empty(steps: int, rows: int, state_dim: int, tokens: int) -> "Rollout":
        """One to be filled in."""
        return Rollout(
            states=torch.empty(steps, rows, state_dim),
            tokens=torch.empty(steps, rows, tokens, dtype=torch.int32),
            root=np.empty((steps, rows, 7), np.float32),
            terminated=np.zeros((steps, rows), bool),
            cut=np.zeros((steps, rows), bool),
            clip=np.full((steps, rows), -1, np.int32),
        )


def roam(
    tokenizer: MotionTokenizer,
    table: ReferenceTable,
    *,
    samples: int = 400_000,
    rows: int = 256,
    seed: int = 0,
    threads: int = 0,
    env: EnvConfig | None = None,
    transitions: float = 0.3,
    code_noise: float = 0.0,
    reach_at_end: float = REACH,
    wander: float = 0.0,
    quiet: bool = False,
) -> Rollout:
    """Roll the frozen tokenizer out for `samples` control steps over `rows` worlds; arguments as of `record`.

    wander: seconds on average after which each row wants to go where a random frame of its clip goes
    (sim.tasks.matching); 0 follows the clips as they are.
    """
    layout, scene = tokenizer.layout, tokenizer.config.scene
    rng = np.random.default_rng([seed, 1])
    tracking = TrackingConfig(future=tokenizer.config.future)
    if wander:
        task = Matching(tracking, table, rows=rows, rng=rng)
    else:
        task = Roaming(tracking, table, rows=rows, transitions=transitions, rng=rng, reach_at_end=reach_at_end)
    task.weights = ClipWeights(len(table.names), rate=1.0, bounds=(0.0, np.inf))  # whatever fails
    task.weights.values = clip_weights(table)
    world = Env(in_scene(env or EnvConfig(), scene), task, rows=rows, threads=threads, seed=seed)
    steps, part = -(-samples // rows), task.layout["state"]
    rolled = Rollout.empty(steps, rows, part.stop - part.start, layout.tokens_per_step)
    obs = world.reset(spread=True)
    log = Logger(None, total=samples, title="record", quiet=quiet)
    with torch.no_grad(), torch_threads(1), log:
        for t in range(steps):
            if isinstance(task, Matching):
                new = np.flatnonzero((t == 0) | (rng.random(rows) < 1 / (wander * scene.control_hz)))
                first, cycle = table.first[task.clip[new]], table.cycle[task.clip[new]]
                task.wish[new] = task.second[first + (rng.random(len(new)) * cycle).astype(int)]
            seen = torch.as_tensor(obs)
            codes = tokenizer.encode(seen)
            rolled.states[t], rolled.tokens[t] = seen[:, part], layout.to_tokens(codes)
            rolled.root[t], rolled.clip[t] = world.sim.qpos[:, :7], task.clip
            played = jitter(codes, code_noise, tokenizer.quantizer.levels[0], rng) if code_noise else codes
            step = world.step(tokenizer.decode(played, seen[:, part]).numpy(force=True))
            rolled.terminated[t], obs = step.terminated, step.obs
            rolled.cut[t] = step.terminated | step.truncated | (task.landing >= 0)
            task.land(world, obs)
            if t % 20 == 19 or t == steps - 1:
                log.write((t + 1) * rows - 1, world.episode_metrics())
    return rolled


def record(
    tokenizer: MotionTokenizer,
    table: ReferenceTable,
    *,
    samples: int = 400_000,
    rows: int = 256,
    seed: int = 0,
    wander: float = 0.0,
    **settings: Any,
) -> TokenDataset:
    """Roll the frozen tokenizer out for `samples` control steps over `rows` worlds; what went well is the data.

    settings: of `roam`. env: pushes, noise and episode length; the physics is the tokenizer's own. code_noise: share of
    the scalars whose executed code is one level off while the recorded one is not, so that the data shows how to go on
    from the states that a prior's own imprecise choices lead to (noise injection, DART: Laskey et al. 2017).
    transitions, reach_at_end: see `Roaming`. wander: where it is above 0, half of the samples are of rows whose wishes
    change after so many seconds, so that one state goes on in many ways. The result depends on `seed` and not on
    `threads`.
    """
    shares = [0.0, wander] if wander else [0.0]
    parts = [
        roam(tokenizer, table, samples=samples // len(shares), rows=rows, seed=seed + 7919 * i, wander=w, **settings)
        for i, w in enumerate(shares)
    ]
    steps = round(BEFORE_FAILURE * tokenizer.config.scene.control_hz)
    good = [torch.as_tensor(~before_failure(part.terminated, part.cut, steps)) for part in parts]
    if not torch.cat(good).any():
        raise ValueError(
            f"the tokenizer follows none of {', '.join(table.names)} for more than {BEFORE_FAILURE} s, so there is "
            "nothing to learn from; look at `kinetok evaluate` of the tokenizer, and fit it longer"
        )
    worlds = [torch.arange(rows, dtype=torch.int32).repeat(len(part.cut), 1) for part in parts]
    return TokenDataset(
        states=torch.cat([part.states[kept] for part, kept in zip(parts, good, strict=True)]),
        tokens=torch.cat([part.tokens[kept] for part, kept in zip(parts, good, strict=True)]),
        clip=torch.cat([torch.as_tensor(part.clip)[kept] for part, kept in zip(parts, good, strict=True)]),
        world=torch.cat([world[kept] for world, kept in zip(worlds, good, strict=True)]),
        names=tuple(table.names),
        starts=draw_starts(table, STARTS, np.random.default_rng([seed, 2])),
    )
