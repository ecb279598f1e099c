"""The table of tasks: each is built from JSON, rolled out in an environment, repeated by its seed and resumed."""

import json

import numpy as np
import pytest

from kinetok.config import ConfigError, from_dict, to_dict
from kinetok.sim import observe
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks import TASKS, Scorecard, build_task
from tests.sim.tasks.planar import standing

EVERY = pytest.mark.parametrize("name", sorted(TASKS))
ROWS = 6


def make(humanoid, name, seed=0, threads=1, **config) -> Env:
    task = build_task(TASKS[name][0](), humanoid, *standing(humanoid, 4), rows=ROWS)
    return Env(EnvConfig(**config), task, rows=ROWS, threads=threads, seed=seed)


def actions(humanoid, steps):
    return np.random.default_rng(3).uniform(-0.6, 0.6, (steps, ROWS, humanoid.nu))


def test_an_unknown_task_is_refused(humanoid):
    class Odd:
        kind = "stearing"

    with pytest.raises(ConfigError, match=r"unknown task 'stearing'; one of: .*; did you mean 'steering'"):
        build_task(Odd(), humanoid, *standing(humanoid, 1), rows=1)


@EVERY
def test_configurations_are_json(name):
    config = TASKS[name][0]()
    assert config.kind == name
    assert from_dict(type(config), json.loads(json.dumps(to_dict(config)))) == config


@EVERY
def test_two_seconds_of_random_targets_with_pushes(humanoid, name):
    env = make(humanoid, name, push=1.0, push_seconds=0.3, episode_seconds=1.5)
    task, obs, ends = env.task, env.reset(), {"terminated": 0, "truncated": 0}
    card = Scorecard(rows=ROWS, control_hz=30)
    for action in actions(humanoid, 60):
        assert obs.shape == (ROWS, env.obs_size) and obs.dtype == np.float32 and np.isfinite(obs).all()
        np.testing.assert_array_equal(obs[:, task.layout["state"]], observe.state_features(env.sim.state()))
        step = env.step(action)
        obs = step.obs
        assert (step.reward >= 0).all() and (step.reward <= 1 + 1e-6).all()
        assert not (step.terminated & step.truncated).any()
        np.testing.assert_allclose(sum(step.terms.values()), step.reward, rtol=1e-6)
        ends["terminated"] += step.terminated.sum()
        ends["truncated"] += step.truncated.sum()
        card.add(step.reward, step.terminated, step.failed, task.measure(env.sim.state()))
        assert all(task.markers(row) for row in range(ROWS))
    assert ends["terminated"] > 0  # a body thrown about falls, and that is a failure and no end of time
    assert env.episode_metrics()["failure_rate"] > 0
    assert json.dumps(card.summary(), allow_nan=False)


@EVERY
def test_time_is_the_environments_and_no_failure(humanoid, name):
    env = make(humanoid, name, episode_seconds=0.1)
    env.reset()
    hold = np.zeros((ROWS, humanoid.nu))
    ends = [(step.terminated.any(), step.truncated.all()) for step in (env.step(hold) for _ in range(3))]
    assert ends == [(False, False), (False, False), (False, True)]


@EVERY
def test_without_autoreset_a_fallen_row_goes_on(humanoid, name):
    env = make(humanoid, name, autoreset=False)
    env.reset()
    lying = env.sim.qpos[[1]].copy()
    lying[:, 2:7] = 0.3, np.sqrt(0.5), 0, np.sqrt(0.5), 0  # face down
    env.sim.set_state(np.array([1]), lying, env.sim.qvel[[1]])
    first, second = (env.step(np.zeros((ROWS, humanoid.nu))) for _ in range(2))
    assert first.terminated.tolist() == second.terminated.tolist() == [False, True, False, False, False, False]
    assert env.age.tolist() == [2] * ROWS


@EVERY
def test_one_seed_is_one_history_at_any_thread_count(humanoid, name):
    histories = []
    for threads, seed in ((1, 0), (2, 0), (1, 1)):
        env = make(humanoid, name, seed=seed, threads=threads, push=0.5, episode_seconds=0.4)
        obs = [env.reset(spread=True)]
        histories.append(np.array(obs + [env.step(a).obs for a in actions(humanoid, 30)]))
    np.testing.assert_array_equal(histories[0], histories[1])
    task = env.task.layout["task"]
    assert (histories[0][:, :, task] != histories[2][:, :, task]).any()


@pytest.mark.parametrize("name", ["target", "steering"])
def test_spread_rows_are_asked_for_something_else_at_different_times(humanoid, name):
    shape = TASKS[name][0]()
    env = Env(EnvConfig(), build_task(shape, humanoid, *standing(humanoid, 4), rows=400), rows=400)
    env.reset()
    longest = shape.seconds[1] * 30
    assert env.task.left.min() >= shape.seconds[0] * 30 - 1
    env.reset(spread=True)
    shares = np.histogram(env.task.left, bins=4, range=(0, longest))[0] / 400
    assert shares[:3].min() > 0.15 and env.task.left.max() <= longest


@EVERY
def test_a_resumed_training_goes_on_as_it_would_have(humanoid, name):
    one, other = make(humanoid, name, episode_seconds=0.4), make(humanoid, name, seed=7, episode_seconds=0.4)
    one.reset()
    for action in actions(humanoid, 20):
        one.step(action)
    other.load_state_dict(json.loads(json.dumps(one.state_dict())))
    np.testing.assert_array_equal(other.reset(spread=True), one.reset(spread=True))
    for action in actions(humanoid, 20):
        np.testing.assert_array_equal(other.step(action).obs, one.step(action).obs)
