"""free.py: where episodes begin, what is seen, and that nothing but a broken state ends one."""

from dataclasses import replace

import numpy as np
import pytest

from kinetok.sim import observe
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.free import Free


def states(humanoid, count):
    qpos = np.tile(humanoid.model.qpos0, (count, 1))
    qpos[:, 0], qpos[:, 2] = np.arange(count), 0.9
    return qpos, np.zeros((count, humanoid.nv))


def test_pinned_rows_begin_where_they_are_told_and_see_their_state_alone(humanoid):
    starts = np.array([2, 0, 2])
    task = Free(humanoid, *states(humanoid, 3), rows=3, starts=starts)
    env = Env(EnvConfig(), task, rows=3, threads=1)
    obs = env.reset()
    np.testing.assert_allclose(env.sim.qpos[:, 0], starts)
    np.testing.assert_array_equal(obs, observe.state_features(env.sim.state()))
    assert obs.shape == (3, task.obs_size) and (task.drawn == starts).all()


def test_unpinned_rows_draw_their_starts(humanoid):
    task = Free(humanoid, *states(humanoid, 4), rows=200)
    qpos, _ = task.start(np.arange(200), np.random.default_rng(0))
    assert set(task.drawn) == {0, 1, 2, 3}
    np.testing.assert_allclose(qpos[:, 0], task.drawn)


def test_a_fall_is_no_end(humanoid):
    env = Env(EnvConfig(episode_seconds=3.0), Free(humanoid, *states(humanoid, 1), rows=2), rows=2, threads=1)
    env.reset()
    for _ in range(60):
        step = env.step(np.full((2, humanoid.nu), 0.5))
        assert not step.terminated.any() and not step.truncated.any() and not step.reward.any()
    assert env.sim.state().pos[:, 0, 2].max() < 0.6


def test_a_broken_state_is_an_end(humanoid):
    task = Free(humanoid, *states(humanoid, 1), rows=2)
    env = Env(EnvConfig(), task, rows=2, threads=1)
    env.reset()
    body = env.sim.state()
    broken = body.pos.copy()
    broken[1, 3, 0] = np.nan
    assert task.over(replace(body, pos=broken))[0].tolist() == [False, True]


@pytest.mark.parametrize(
    ("qpos", "starts", "message"),
    [
        (np.zeros((2, 5)), None, r"needs \(K, 43\) and \(K, 34\)"),
        (np.zeros((0, 43)), None, "same K > 0"),
        (np.zeros((2, 43)), np.array([0, 2]), "one of the 2 start states for each of 2 rows"),
        (np.zeros((2, 43)), np.array([0]), "for each of 2 rows"),
    ],
)
def test_bad_starts_are_refused(humanoid, qpos, starts, message):
    with pytest.raises(ValueError, match=message):
        Free(humanoid, qpos, np.zeros((len(qpos), humanoid.nv)), rows=2, starts=starts)
