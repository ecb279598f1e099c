"""env.py: episodes end for one of two reasons, resets keep the last observation, failures stay in their row."""

import numpy as np
import pytest

from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.tracking import Failure, Tracking, TrackingConfig

ROWS = 6


def make(table, rows=ROWS, seed=0, threads=1, fixed=None, starts=None, loose=False, **config) -> Env:
    failure = Failure(largest=1e9, mean=1e9) if loose else Failure()
    task = Tracking(TrackingConfig(future=(1, 3), failure=failure), table, rows=rows, fixed=fixed, starts=starts)
    return Env(EnvConfig(**config), task, rows=rows, threads=threads, seed=seed)


def actions(env, steps, seed=0):
    return 0.1 * np.random.default_rng(seed).standard_normal((steps, env.rows, env.action_size))


def pinned(clip: int, start: int):
    return {"fixed": np.full(ROWS, clip), "starts": np.full(ROWS, start)}


def test_time_and_clip_ends_truncate(table):
    timed = make(table, loose=True, episode_seconds=0.1, **pinned(0, 0))  # 3 steps of a loop
    ended = make(table, loose=True, episode_seconds=9.0, **pinned(1, 12))  # frames 12 .. 15 of 15
    for env in (timed, ended):
        env.reset()
        steps = [env.step(a) for a in actions(env, 4)]
        assert [step.truncated.all() for step in steps] == [False, False, True, False]
        assert not any(step.terminated.any() for step in steps)
        assert steps[2].done.tolist() == list(range(ROWS))
        metrics = env.episode_metrics()
        assert metrics["failure_rate"] == 0.0 and metrics["episode_seconds"] == pytest.approx(0.1)
        assert metrics["episode_return"] == pytest.approx(np.mean(sum(s.reward for s in steps[:3])), rel=1e-5)
        assert env.episode_metrics() == {}


def test_episodes_last_as_long_as_they_did_whenever_they_began(table):
    env = make(table, loose=True, episode_seconds=0.3, **pinned(0, 0))
    env.reset(spread=True)
    begun = env.age.copy()
    for a in actions(env, 9):
        env.step(a)
    assert len(set(begun)) > 1 and env.episode_metrics()["episode_seconds"] == pytest.approx((9 - begun).mean() / 30)


def test_a_failure_terminates_and_is_not_truncated_too(table):
    env = make(table, episode_seconds=1 / 30, **pinned(0, 0))  # time is over after one step, for every row
    env.reset()
    far = env.sim.qpos[[2]].copy()
    far[:, 0] += 5.0
    env.sim.set_state(np.array([2]), far, env.sim.qvel[[2]])
    step = env.step(actions(env, 1)[0])
    assert step.terminated.tolist() == [False, False, True, False, False, False]
    assert step.truncated.tolist() == [True, True, False, True, True, True]
    assert env.episode_metrics()["failure_rate"] == pytest.approx(1 / 6)


def test_final_obs_is_the_observation_before_the_reset(table):
    short = make(table, loose=True, episode_seconds=0.1, **pinned(0, 4))
    long = make(table, loose=True, episode_seconds=9.0, **pinned(0, 4))
    np.testing.assert_array_equal(short.reset(), long.reset())
    first = short.task.observe(short.sim.state())
    for a in actions(short, 3):
        ended, went_on = short.step(a), long.step(a)
    np.testing.assert_array_equal(ended.final_obs, went_on.obs)
    np.testing.assert_allclose(ended.obs, first, atol=1e-6)  # and the new episodes begin at the pinned frame
    assert np.abs(ended.obs - ended.final_obs).max() > 0.01


def test_only_finished_rows_have_a_final_obs(table):
    env = make(table, loose=True, episode_seconds=9.0, fixed=np.array([1, 0, 1, 0, 0, 0]), starts=np.full(ROWS, 14))
    env.reset()
    step = env.step(actions(env, 1)[0])
    assert step.done.tolist() == [0, 2] and step.final_obs.shape == (2, env.obs_size)
    assert env.age.tolist() == [0, 1, 0, 1, 1, 1]


def test_spread_draws_ages(table):
    env = make(table, rows=200, episode_seconds=1.0, loose=True)
    env.reset(spread=True)
    assert env.age.min() >= 0 and env.age.max() < env.limit == 30
    assert len(np.unique(env.age)) > 20
    env.reset()
    assert (env.age == 0).all()


def test_pushes_change_the_horizontal_root_velocity_only(table):
    calm = make(table, loose=True, **pinned(0, 0))
    pushed = make(table, loose=True, push=0.7, push_seconds=2 / 30, push_regular=True, **pinned(0, 0))
    for env in (calm, pushed):
        env.reset()
    for number, a in enumerate(actions(calm, 2)):
        calm.step(a), pushed.step(a)
        np.testing.assert_array_equal(pushed.sim.qpos, calm.sim.qpos)
        delta = pushed.sim.qvel - calm.sim.qvel
        assert (delta[:, 2:] == 0).all()
        np.testing.assert_allclose(np.linalg.norm(delta[:, :2], axis=1), 0.7 * (number == 1), atol=1e-9)


def test_random_pushes_come_as_often_as_asked(table):
    calm, pushed = (make(table, rows=100, loose=True, push=p, push_seconds=0.5) for p in (0.0, 1.0))
    hits = 0
    for env in (calm, pushed):
        env.reset()
    for a in actions(calm, 6):
        before = pushed.sim.qvel.copy()
        calm.sim.set_state(np.arange(100), pushed.sim.qpos.copy(), before)
        calm.sim.step(a, 4)
        pushed.step(a)
        size = np.linalg.norm(pushed.sim.qvel[:, :2] - calm.sim.qvel[:, :2], axis=1)
        hits += (size > 1e-3).sum()
        assert size.max() <= 1.1
    assert hits / 600 == pytest.approx(1 / 15, abs=0.04)


def test_a_failed_simulation_is_reset_counted_and_contained(table, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log file where it stands
    good, bad = (make(table, loose=True, **pinned(0, 3)) for _ in range(2))
    for env in (good, bad):
        env.reset()
    bad.sim.qvel[2, 8] = np.nan
    a = actions(good, 2)
    fine, step = good.step(a[0]), bad.step(a[0])
    assert bad.failed_simulations == 1 and step.terminated.tolist() == [False, False, True, False, False, False]
    assert step.done.tolist() == [2]
    for values in (step.obs, step.reward, step.final_obs, *step.terms.values()):
        assert np.isfinite(values).all()
    others = [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(step.obs[others], fine.obs[others])
    np.testing.assert_array_equal(step.reward[others], fine.reward[others])
    assert not bad.step(a[1]).terminated.any() and bad.failed_simulations == 1


def test_one_seed_is_one_history_at_any_thread_count(table):
    config = {"push": 0.5, "push_seconds": 0.2, "reset_noise": 0.05, "friction": (0.5, 1.5), "episode_seconds": 0.3}
    histories = []
    for threads, seed in ((1, 0), (2, 0), (1, 1)):
        env = make(table, threads=threads, seed=seed, **config)
        obs = [env.reset(spread=True)]
        histories.append(np.array(obs + [env.step(a).obs for a in actions(env, 12)]))
    np.testing.assert_array_equal(histories[0], histories[1])
    assert (histories[0] != histories[2]).any()


def test_state_dict_restores_the_random_state_and_the_weights(table):
    env = make(table, rows=40, episode_seconds=0.2)
    env.reset()
    for a in actions(env, 12):
        env.step(a)
    other = make(table, rows=40, seed=7, episode_seconds=0.2)
    other.load_state_dict(env.state_dict())
    np.testing.assert_array_equal(other.reset(), env.reset())
