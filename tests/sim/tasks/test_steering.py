"""steering.py: eq. 11-13 by hand, commands in the heading frame, when they change."""

import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.sim.tasks.steering import Steering, SteeringConfig
from tests.sim.tasks.planar import body_at, moved, standing


def make(humanoid, rows, **config) -> Steering:
    task = Steering(SteeringConfig(**config), humanoid, *standing(humanoid, 5), rows=rows)
    task.start(np.arange(rows), np.random.default_rng(0))
    return task


def test_reward_by_hand(humanoid):
    task = make(humanoid, 4)
    task.angle[:], task.speed[:], task.facing[:] = 0.0, 1.5, np.pi / 3
    velocity = np.array([[1.0, 0.5], [1.5, 0.0], [-0.1, 0.0], [0.0, 1.5]], dtype=np.float32)
    reward, terms = task.reward(body_at([[0, 0]] * 4, angle=[0.0, np.pi / 3, 0.0, np.pi], velocity=velocity))
    # .7 exp(-.25 (.5^2 + .1 * .5^2)) = .7 exp(-.06875) = .653493; exact: .7; backwards and sideways: 0
    np.testing.assert_allclose(terms["direction"], [0.653493, 0.7, 0.0, 0.0], rtol=1e-5)
    # cos 60 = .5: .15; aligned: .3; .15; cos 120 < 0: 0
    np.testing.assert_allclose(terms["facing"], [0.15, 0.3, 0.15, 0.0], atol=1e-6)
    np.testing.assert_allclose(reward, [0.803493, 1.0, 0.15, 0.0], atol=1e-6)


def test_errors_by_hand(humanoid):
    task = make(humanoid, 2)
    task.angle[:], task.speed[:], task.facing[:] = np.pi / 2, 1.0, 3.0
    found = task.measure(body_at([[0, 0]] * 2, angle=[0.0, -3.0], velocity=[[0.0, 1.0], [0.6, 0.2]]))
    np.testing.assert_allclose(found["velocity_error_mps"], [0, 1.0], atol=1e-6)  # (.6, .2 - 1): 1
    np.testing.assert_allclose(found["heading_error_rad"], [3.0, 2 * np.pi - 6.0], atol=1e-6)  # the short way


def test_the_command_as_the_character_sees_it(humanoid):
    task = make(humanoid, 1)
    task.angle[:], task.speed[:], task.facing[:] = 0.0, 1.5, np.pi
    obs = task.observe(body_at([[4, 5]], angle=np.pi / 2))
    # heading along y: a velocity along x is to the right, a facing along -x to the left
    np.testing.assert_allclose(obs[0, task.layout["task"]], [0, -1.5, 0, 1], atol=1e-6)


def test_a_world_turned_and_shifted_is_the_same_world(humanoid):
    task = make(humanoid, 4)
    velocity = np.random.default_rng(2).normal(size=(4, 2))
    body = body_at([[0, 0], [1, 0], [2, 1], [3, 5]], angle=[0.1, 1.0, -2.0, 3.0], velocity=velocity)
    before = task.observe(body), task.reward(body)[0]
    task.angle, task.facing = task.angle + np.float32(2.1), task.facing + np.float32(2.1)
    other = moved(body, 2.1, (30, -20))
    np.testing.assert_allclose(task.observe(other), before[0], atol=2e-5)
    np.testing.assert_allclose(task.reward(other)[0], before[1], atol=1e-5)


def test_rows_by_id(humanoid):
    task = make(humanoid, 4)
    body, ids = body_at([[0, 0], [1, 0], [2, 1], [3, 5]], angle=0.4), np.array([3, 1])
    np.testing.assert_array_equal(task.observe(body.rows(ids), ids), task.observe(body)[ids])


def test_commands_change_after_2_to_5_seconds(humanoid):
    task = make(humanoid, 300)
    assert 60 <= task.left.min() < 70 and 140 < task.left.max() <= 150
    left, speed = task.left.copy(), task.speed.copy()
    for t in range(1, 61):
        task.advance()
        assert ((task.speed != speed) == (t >= left)).all()


def test_commands_lie_where_the_configuration_says(humanoid):
    task = make(humanoid, 2000, turn=0.5, free_facing=0.25, speed=(1.0, 1.2))
    assert 0.45 < np.abs(task.angle).max() <= 0.5 + 1e-6  # the starts head along x
    assert 1.0 <= task.speed.min() < 1.01 and 1.19 < task.speed.max() <= 1.2 + 1e-6
    aside = np.abs(task.facing - task.angle) > 1e-6
    assert aside.mean() == pytest.approx(0.25, abs=0.03)
    assert (make(humanoid, 100, free_facing=0.0).facing == make(humanoid, 100, free_facing=0.0).angle).all()


def test_arrows_show_the_command(humanoid):
    task = make(humanoid, 1)
    task.over(body_at([[2, 3]]))
    task.angle[:], task.speed[:], task.facing[:] = np.pi / 2, 1.5, 0.0
    velocity, facing = task.markers(0)
    np.testing.assert_allclose(np.subtract(velocity.end, velocity.pos), [0, 1.5, 0], atol=1e-6)
    np.testing.assert_allclose(np.subtract(facing.end, facing.pos), [0.6, 0, 0], atol=1e-6)
    np.testing.assert_allclose(velocity.pos[:2], [2, 3])


@pytest.mark.parametrize("wrong", [{"free_facing": 1.5}, {"turn": 4.0}, {"speed": (0.0, 1.0)}])
def test_commands_that_cannot_be_are_refused(wrong):
    with pytest.raises(ConfigError):
        SteeringConfig(**wrong)
