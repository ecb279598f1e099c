"""matching.py: of the frames a body resembles, the one that goes where it is wished."""

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.matching import Matching
from kinetok.sim.tasks.tracking import ReferenceTable, TrackingConfig


def turning(humanoid, name: str, rate: float, x: float) -> Clip:
    """A standing body carried along at 1 m/s for 4 s: straight for one, then on a circle of `rate` rad/s."""
    time = np.arange(121) / 30
    angle = rate * np.maximum(time - 1, 0)
    qpos = np.tile(humanoid.stand(), (121, 1))
    qpos[:, 0] = x + np.cumsum(np.cos(angle)) / 30
    qpos[:, 1] = np.cumsum(np.sin(angle)) / 30
    qpos[:, 3:7] = rotation.about_z(angle)
    return Clip(name=name, character="humanoid", fps=30.0, qpos=qpos)


@pytest.mark.parametrize(("wish", "clip"), [((0.7, 0.6), "left"), ((0.7, -0.6), "right")])
def test_a_row_goes_on_where_the_clip_goes_as_wished(humanoid, wish, clip):
    table = ReferenceTable(
        ClipLibrary.of([turning(humanoid, n, r, x) for n, r, x in (("left", 1.0, 0), ("right", -1.0, 9))])
    )
    task = Matching(TrackingConfig(future=(1, 2)), table, rows=32, rng=np.random.default_rng(0))
    env = Env(EnvConfig(), task, rows=32, threads=1)
    env.reset()
    frame = table.first[np.arange(32) % 2] + 20
    task.place(np.arange(32), np.arange(32) % 2, frame)
    env.sim.set_state(np.arange(32), table.qpos[frame], table.qvel[frame])
    task.wish[:] = wish
    for _ in range(60):  # the searches are random: one in twelve steps
        task.over(env.sim.state())
        obs = task.observe(env.sim.state())
        task.land(env, obs)
    assert (np.array(table.names)[task.clip] == clip).all()
    second = task.second[task.frame]
    assert np.linalg.norm(second - wish, axis=1).max() < 0.3


def test_a_clip_that_does_as_wished_is_not_left(humanoid):
    table = ReferenceTable(ClipLibrary.of([turning(humanoid, "left", 1.0, 0), turning(humanoid, "again", 1.0, 9)]))
    task = Matching(TrackingConfig(future=(1, 2)), table, rows=8, rng=np.random.default_rng(0))
    env = Env(EnvConfig(), task, rows=8, threads=1)
    env.reset()
    frame = np.full(8, 45)
    task.place(np.arange(8), np.zeros(8, int), frame)
    env.sim.set_state(np.arange(8), table.qpos[frame], table.qvel[frame])
    task.wish[:] = task.second[frame]
    for _ in range(40):
        task.over(env.sim.state())
        assert (task.landing == -1).all()


def test_a_driven_row_is_found_again_and_only_a_fall_ends_it(humanoid):
    table = ReferenceTable(ClipLibrary.of([turning(humanoid, "left", 1.0, 0)]))
    task = Matching(TrackingConfig(future=(1, 2)), table, rows=4, rng=np.random.default_rng(0))
    task.driven[:] = [True, True, False, False]
    env = Env(EnvConfig(), task, rows=4, threads=1)
    env.reset()
    frame = np.full(4, 20)
    task.place(np.arange(4), np.zeros(4, int), frame)
    qpos, qvel = table.qpos[frame].copy(), table.qvel[frame]
    qpos[:, 1] += [3.0, 3.0, 3.0, 0.0]  # far from what they follow, though they resemble it
    qpos[1, 2] = 0.3
    env.sim.set_state(np.arange(4), qpos, qvel)
    terminated, over = task.over(env.sim.state())
    assert terminated.tolist() == [False, True, True, False] and not over.any()
    assert (task.landing[[1, 2]] == -1).all()
    task.wish[:] = task.second[60]  # it now wants to turn, and goes on where the clip does
    for _ in range(60):
        task.over(env.sim.state())
        task.land(env, task.observe(env.sim.state()))
        if task.frame[0] != 20:
            break
    root = env.sim.state().pos[0, 0, :2]
    assert task.frame[0] >= 30 and np.linalg.norm(root - table.root[task.frame[0], :2]) < 1e-3
