"""target.py: eq. 10 by hand, when and where targets come, what a target's end tells."""

import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.sim.tasks.target import Target, TargetConfig
from tests.sim.tasks.planar import body_at, moved, standing, turned


def make(humanoid, rows, **config) -> Target:
    task = Target(TargetConfig(**config), humanoid, *standing(humanoid, 5), rows=rows)
    task.start(np.arange(rows), np.random.default_rng(0))
    return task


def test_reward_by_hand(humanoid):
    task = make(humanoid, 3)
    task.target[:] = [[3, 4], [0.3, 0.39], [0.3, 0.41]]
    reward, terms = task.reward(body_at([[0, 0]] * 3))
    # 5 m: exp(-.42 * 5) = exp(-2.1); sqrt(.09 + .1521) = .4920 < .5: 1; sqrt(.09 + .1681) = .50804: exp(-.21338)
    np.testing.assert_allclose(reward, [0.122456, 1.0, 0.807849], rtol=1e-5)
    np.testing.assert_array_equal(terms["target"], reward)


def test_reward_that_is_full_further_in(humanoid):
    task = make(humanoid, 2, full=0.3)
    task.target[:] = [[0.4, 0], [0.29, 0]]
    body = body_at([[0, 0]] * 2)
    np.testing.assert_allclose(task.reward(body)[0], [0.845354, 1.0], rtol=1e-5)  # exp(-.42 * .4) = exp(-.168)
    task.over(body)
    assert task.reached.all()  # what counts as reached stays
    with pytest.raises(ConfigError, match=r"full is metres .* not -0.1"):
        TargetConfig(full=-0.1)


def test_the_target_as_the_character_sees_it(humanoid):
    task = make(humanoid, 2)
    task.target[:] = [[1, 3], [1, 3]]
    obs = task.observe(body_at([[1, 1], [0, 3]], angle=[0.0, np.pi / 2]))
    # 2 m to the left of a heading along x; 1 m along x is to the right of a heading along y; then unit vectors
    np.testing.assert_allclose(obs[:, task.layout["task"]], [[0, 2, 0, 1], [0, -1, 0, -1]], atol=1e-6)
    assert obs.shape == (2, task.obs_size)


def test_a_world_turned_and_shifted_is_the_same_world(humanoid):
    task = make(humanoid, 4)
    body = body_at(np.random.default_rng(1).normal(size=(4, 2)), angle=[0.1, 1.0, -2.0, 3.0], velocity=[0.5, 0.2])
    before = task.observe(body), task.reward(body)[0]
    task.target = turned(task.target, 2.1) + np.float32([30, -20])
    other = moved(body, 2.1, (30, -20))
    np.testing.assert_allclose(task.observe(other), before[0], atol=2e-5)
    np.testing.assert_allclose(task.reward(other)[0], before[1], atol=1e-5)


def test_rows_by_id(humanoid):
    task = make(humanoid, 4)
    body, ids = body_at([[0, 0], [1, 0], [2, 1], [3, 5]], angle=0.4), np.array([3, 1])
    np.testing.assert_array_equal(task.observe(body.rows(ids), ids), task.observe(body)[ids])


def test_targets_stay_for_6_to_8_seconds_and_lie_around_the_root(humanoid):
    rows = 400
    task = make(humanoid, rows)
    assert 180 <= task.left.min() < 190 and 230 < task.left.max() <= 240  # 6 to 8 s at 30 Hz
    left, first = task.left.copy(), task.target.copy()
    here = body_at(np.tile([[20.0, -10.0]], (rows, 1)))
    for t in range(1, 241):
        task.advance()
        changed = (task.target != first).any(1)
        assert (changed == (t >= left)).all()
        task.over(here)  # where the roots are, for the next target
    distance = np.linalg.norm(task.target - [20, -10], axis=1)
    assert 1 - 1e-5 <= distance.min() < 1.1 and 4.9 < distance.max() <= 5 + 1e-5
    angle = np.arctan2(*(task.target - [20, -10]).T)
    assert np.histogram(angle, 4, (-np.pi, np.pi))[0].min() > 70  # all around


def test_what_the_end_of_a_target_tells(humanoid):
    task = make(humanoid, 2, seconds=(0.1, 0.1))  # 3 control steps
    task.target[:] = [[2, 0], [2, 0]]
    ends = []
    # row 0 passes within .5 m in its second step and goes on; row 1 comes to .6 m
    for x in ([1.0, 0.5], [1.6, 1.0], [3.0, 1.4], [9.0, 9.0]):
        task.advance()
        body = body_at([[x[0], 0], [x[1], 0]])
        task.over(body)
        ends.append(task.measure(body))
    # the third advance ends both targets, as they were left in the second step; the fourth begins to count anew
    for name in ("success_rate", "final_distance_m"):
        assert [np.isnan(end[name]).all() for end in ends] == [True, True, False, True]
    assert ends[2]["success_rate"].tolist() == [1.0, 0.0] and not task.reached[1]
    np.testing.assert_allclose(ends[2]["final_distance_m"], [0.4, 1.0], rtol=1e-5)
    np.testing.assert_allclose(ends[1]["target_distance_m"], [0.4, 1.0], rtol=1e-5)


def test_reached_once_is_reached(humanoid):
    task = make(humanoid, 1)
    task.target[:] = [[2, 0]]
    colours = []
    for x in (0.0, 1.7, 0.0):
        task.over(body_at([[x, 0]]))
        colours.append(task.markers(0)[0].rgba)
    assert colours[0] != colours[1] == colours[2]


def test_a_target_under_the_feet_is_refused():
    with pytest.raises(ConfigError, match="reached without a step"):
        TargetConfig(distance=(0.1, 0.4))


def test_demonstrations_ask_to_stay_too(humanoid):
    task = make(humanoid, 256)
    task.config = task.config.restless((0.4, 4.0))
    task.start(np.arange(256), np.random.default_rng(0))
    away = np.linalg.norm(task.target - task.world.root[:, :2], axis=1)
    assert 0.05 < (away < task.config.near).mean() < 0.2 and away.max() > 4


def test_a_demonstration_wants_to_come_nearer_and_to_rest_before_the_middle(humanoid):
    # 5 m away: as far as a demonstration goes in a second; 0.8 m: to 0.6 of near = 0.5 m; 0.2 m: nowhere
    c = np.array([[3, 4, 0.6, 0.8], [0, -0.8, 0, -1], [0.2, 0, 1, 0]], np.float32)
    np.testing.assert_allclose(make(humanoid, 3).wish(c), [[0.72, 0.96], [0, -0.5], [0, 0]], atol=1e-6)
