"""Demonstrations of a task: motion matching picks the reference, the frozen tokenizer follows, its tokens are learned.

    states, c, tokens = demonstrate(tokenizer, table, goal, samples=300_000, rows=256, seed=0)

The goal (a task of sim.tasks) asks as it does in play; `goal.wish` says where the root would have to be in a second.
What the tracker's tokens are, in the states they lead to and under what was asked there, is what supervised
fine-tuning learns. A row that goes on in another clip has its body moved there (sim.tasks.roaming); the goal sees it
where it would be without that.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from kinetok import rotation
from kinetok.gpt.data import before_failure, jitter
from kinetok.logger import Logger
from kinetok.rl.rollout import torch_threads
from kinetok.sim.batch import BodyState
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks import Goal
from kinetok.sim.tasks.matching import Matching
from kinetok.sim.tasks.tracking import ReferenceTable, TrackingConfig
from kinetok.tokenizers.tokenizer import MotionTokenizer
from kinetok.tokenizers.train import in_scene

TURN = np.pi / 3  # radians to either side of straight ahead


def forwards(wish: np.ndarray) -> np.ndarray:
    """Wishes (N, 2) as long as they are, and at most TURN to the side: what lies behind is to be turned to.

    No motion here goes backwards or sideways, so where that is asked for, standing still misses by least, for ever.
    """
    length = np.linalg.norm(wish, axis=1)
    angle = np.arctan2(wish[:, 1], wish[:, 0]).clip(-TURN, TURN)
    return np.stack([length * np.cos(angle), length * np.sin(angle)], axis=1)


class Place:
    """Where rows would be had they never been moved: world = turned by `angle` (N,) and shifted by `shift` (N, 2)."""

    def __init__(self, rows: int):
        self.angle, self.shift = np.zeros(rows, np.float32), np.zeros((rows, 2), np.float32)

    def seen(self, body: BodyState) -> BodyState:
        """The state there."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        pos, linear, angular = (
            rotation.turn(vectors, cos[:, None], sin[:, None]) for vectors in (body.pos, body.linear, body.angular)
        )
        pos[..., :2] += self.shift[:, None]
        mat = rotation.turn(np.swapaxes(body.mat, -1, -2), cos[:, None, None], sin[:, None, None])
        quat = rotation.multiply(rotation.about_z(self.angle), body.quat).astype(np.float32)
        return BodyState(pos=pos, mat=np.swapaxes(mat, -1, -2), linear=linear, angular=angular, quat=quat)

    def keep(self, ids: np.ndarray, xy: np.ndarray, heading: np.ndarray, body: BodyState) -> None:
        """Let rows ids, whose body is now elsewhere, be seen at xy (n, 2) with heading (n,)."""
        self.angle[ids] = heading - rotation.heading(body.quat[ids])
        cos, sin, root = np.cos(self.angle[ids]), np.sin(self.angle[ids]), body.pos[ids, 0]
        self.shift[ids] = xy - rotation.turn(root, cos, sin)[:, :2]


def demonstrate(
    tokenizer: MotionTokenizer,
    table: ReferenceTable,
    goal: Goal,
    *,
    samples: int = 300_000,
    rows: int = 256,
    seed: int = 0,
    threads: int = 0,
    env: EnvConfig | None = None,
    code_noise: float = 0.05,
    doomed: float = 1.0,
    driver: Callable[[Tensor], Tensor] | None = None,
    quiet: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """states (M, S), task observations (M, C) and tokens (M, K) of what was followed for `samples` control steps.

    goal: of as many rows. doomed: seconds before a failure that are left out. code_noise: as in recording for a prior.
    driver: who acts instead of the tokenizer in every second row, from states and task observations (N, S + C) to PD
    targets; the tokenizer's tokens remain the lesson, so that it says how to go on from where the driver's choices lead
    (DAgger, Ross et al. 2011). The result depends on `seed` and not on `threads`.
    """
    layout, scene = tokenizer.layout, tokenizer.config.scene
    rng = np.random.default_rng([seed, 5])
    task = Matching(TrackingConfig(future=tokenizer.config.future), table, rows=rows, rng=rng)
    task.driven[::2] = driver is not None
    world = Env(in_scene(env or EnvConfig(), scene), task, rows=rows, threads=threads, seed=seed)
    steps, part, asked = -(-samples // rows), task.layout["state"], goal.layout["task"]
    states = torch.empty(steps, rows, part.stop - part.start)
    c = torch.empty(steps, rows, asked.stop - asked.start)
    tokens = torch.empty(steps, rows, layout.tokens_per_step, dtype=torch.int32)
    terminated, done = np.zeros((2, steps, rows), bool)
    everyone, place = np.arange(rows), Place(rows)
    obs = world.reset(spread=True)
    qpos, _ = goal.start(everyone, rng)
    body = world.sim.state()
    place.keep(everyone, qpos[:, :2], rotation.heading(qpos[:, 3:7]), body)
    log = Logger(None, total=samples, title="demonstrate", quiet=quiet)
    with torch.no_grad(), torch_threads(1), log:
        for t in range(steps):
            there = place.seen(body)
            asking = goal.observe(there)[:, asked]
            task.wish[:] = forwards(goal.wish(asking))
            seen = torch.as_tensor(obs)
            codes = tokenizer.encode(seen)
            states[t], c[t], tokens[t] = seen[:, part], torch.as_tensor(asking), layout.to_tokens(codes)
            played = jitter(codes, code_noise, tokenizer.quantizer.levels[0], rng) if code_noise else codes
            action = tokenizer.decode(played, seen[:, part])
            if driver is not None:
                action[::2] = driver(torch.cat([states[t], c[t]], 1)[::2])
            step = world.step(action.numpy(force=True))
            terminated[t], obs = step.terminated, step.obs
            done[t, step.done] = True
            # A row that ended begins anew where it was; one that lands has come to where its body is now.
            landing = np.flatnonzero((task.landing >= 0) & ~done[t])
            arrived = place.seen(world.sim.state())
            old = there.pos[:, 0, :2].copy()
            heading = rotation.heading(there.quat)
            old[landing], heading[landing] = arrived.pos[landing, 0, :2], rotation.heading(arrived.quat[landing])
            task.land(world, obs)
            body = world.sim.state()
            place.keep(step.done, old[step.done], heading[step.done], body)
            place.keep(landing, old[landing], heading[landing], body)
            goal.advance()
            goal.over(place.seen(body))
            if t % 20 == 19 or t == steps - 1:
                log.write((t + 1) * rows - 1, world.episode_metrics())
    kept = torch.as_tensor(~before_failure(terminated, done, round(doomed * scene.control_hz)))
    return states[kept], c[kept], tokens[kept]
