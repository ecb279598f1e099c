"""path.py: eq. 14 by hand, paths that are smooth and within their limits, waypoints in the heading frame."""

import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.sim.tasks.path import Path, PathConfig
from tests.sim.tasks.planar import body_at, moved, standing, turned


def make(humanoid, rows, qvel=None, **config) -> Path:
    qpos, still = standing(humanoid, 5)
    task = Path(PathConfig(**config), humanoid, qpos, still if qvel is None else qvel, rows=rows)
    task.start(np.arange(rows), np.random.default_rng(0))
    return task


def straight(humanoid, rows=1) -> Path:
    """A path along x at 1.2 m/s, that is .04 m a control step."""
    task = make(humanoid, rows)
    task.points[..., 0] = 0.04 * np.arange(task.points.shape[1])
    task.points[..., 1] = 0.0
    return task


def test_reward_by_hand(humanoid):
    task = straight(humanoid, 3)
    for _ in range(5):
        task.advance()
    # now at x = .2: 0 m: 1; .5 m: exp(-1) = .367879; .3, .4 away: the same
    reward, terms = task.reward(body_at([[0.2, 0], [0.2, 0.5], [0.5, -0.4]]))
    np.testing.assert_allclose(reward, [1.0, 0.367879, 0.367879], rtol=1e-5)
    np.testing.assert_array_equal(terms["path"], reward)
    np.testing.assert_allclose(
        task.measure(body_at([[0.2, 0], [0.2, 0.5], [0.5, -0.4]]))["path_distance_m"], [0, 0.5, 0.5]
    )


def test_ten_waypoints_over_five_seconds(humanoid):
    task = straight(humanoid)
    for _ in range(5):
        task.advance()
    obs = task.observe(body_at([[0.2, 1.0]]))
    waypoints = obs[0, task.layout["task"]].reshape(10, 2)
    # half a second is 15 steps of .04 m; the path is 1 m to the right
    np.testing.assert_allclose(waypoints, [[0.6 * k, -1.0] for k in range(1, 11)], atol=1e-5)
    other = task.observe(body_at([[0.2, 1.0]], angle=np.pi / 2))[0, task.layout["task"]].reshape(10, 2)
    np.testing.assert_allclose(other, [[-1.0, -0.6 * k] for k in range(1, 11)], atol=1e-5)


def test_a_world_turned_and_shifted_is_the_same_world(humanoid):
    task = make(humanoid, 4)
    body = body_at([[0, 0], [1, 0], [2, 1], [3, 5]], angle=[0.1, 1.0, -2.0, 3.0], velocity=[0.5, 0.2])
    before = task.observe(body), task.reward(body)[0]
    task.points = turned(task.points, 2.1) + np.float32([30, -20])
    other = moved(body, 2.1, (30, -20))
    np.testing.assert_allclose(task.observe(other), before[0], atol=3e-5)
    np.testing.assert_allclose(task.reward(other)[0], before[1], atol=2e-5)


def test_rows_by_id(humanoid):
    task = make(humanoid, 4)
    body, ids = body_at([[0, 0], [1, 0], [2, 1], [3, 5]], angle=0.4), np.array([3, 1])
    np.testing.assert_array_equal(task.observe(body.rows(ids), ids), task.observe(body)[ids])


def test_paths_are_smooth_endless_and_within_their_limits(humanoid):
    task = make(humanoid, 50)
    walked = [task.target.copy()]
    for t in range(1, 401):
        ahead = task.points[:, task.now + 1 : task.now + 151].copy()
        task.advance()
        np.testing.assert_array_equal(task.target, ahead[:, 0])  # what was seen ahead is what comes
        np.testing.assert_array_equal(task.points[:, task.now : task.now + 149], ahead[:, :149])
        walked.append(task.target.copy())
        if t in (7, 100):  # rows that begin anew leave the others alone
            others = task.points[1:].copy()
            task.start(np.array([0]), np.random.default_rng(t))
            np.testing.assert_array_equal(task.points[1:], others)
    steps = np.diff(np.array(walked)[:, 1:].astype(np.float64), axis=0) * 30
    speed, angle = np.hypot(*np.moveaxis(steps, -1, 0)), np.unwrap(np.arctan2(steps[..., 1], steps[..., 0]), axis=0)
    assert 0.7 - 1e-3 < speed.min() < 0.75 and 1.05 < speed.max() < 1.1 + 1e-3
    assert np.abs(np.diff(speed, axis=0)).max() * 30 < 0.5 + 2e-2  # acceleration
    assert 0.55 < np.abs(np.diff(angle, axis=0)).max() * 30 < 0.6 + 2e-2  # turn rate


def test_a_path_begins_below_the_root_as_it_moves(humanoid):
    qvel = np.zeros((5, humanoid.nv))
    qvel[:, 0] = [0.0, 1.0, 1.2, 9.0, 0.7]  # clipped to .6 .. 1.5 m/s
    task = make(humanoid, 40, qvel=qvel, speed=(0.6, 1.5), turn=1e-6, acceleration=1e-6)
    np.testing.assert_allclose(
        task.target[:, 0], task.world.free.drawn, atol=1e-6
    )  # the starts stand at x = 0, 1, 2 ..
    task.advance()
    expected = np.array([0.6, 1.0, 1.2, 1.5, 0.7])[task.world.free.drawn] / 30
    np.testing.assert_allclose(task.target - task.world.root[:, :2], np.stack([expected, 0 * expected], 1), atol=2e-6)


def test_far_from_the_path_is_a_failure_only_where_asked(humanoid):
    body = body_at([[0.0, 1.9], [0.0, 2.1]])
    strict, lenient = straight(humanoid, 2), straight(humanoid, 2)
    strict.config = PathConfig(far=2.0)
    assert strict.over(body)[0].tolist() == [False, True] and not strict.over(body)[1].any()
    assert not lenient.over(body)[0].any()


def test_markers_lead_along_the_path(humanoid):
    task = straight(humanoid)
    here, *dots = task.markers(0)
    assert here.shape == "disc" and here.pos == (0.0, 0.0, 0.0)
    np.testing.assert_allclose([dot.pos[0] for dot in dots][:3], [0.2, 0.4, 0.6], atol=1e-6)
    assert dots[2].radius > dots[0].radius and dots[-1].pos[0] >= 6.0


def test_paths_that_cannot_be_are_refused(humanoid):
    with pytest.raises(ConfigError, match="a path has waypoints"):
        PathConfig(waypoints=0)
    with pytest.raises(ConfigError, match=r"400 waypoints in 5.0 s are closer than 1/30 s"):
        make(humanoid, 1, waypoints=400)


def test_a_restless_path_jumps_and_goes_on_as_it_was(humanoid):
    task = make(humanoid, 200)
    task.config = task.config.restless((0.4, 4.0))
    task.start(np.arange(200), np.random.default_rng(0))
    moved = []
    for _ in range(120):
        before, now = task.points.copy(), task.now
        task.advance()
        shift = task.points - before if task.now == now + 1 else task.points[:, : -task.arc] - before[:, task.arc :]
        np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=1e-5)  # all of it, or none
        moved.append(np.linalg.norm(shift[:, 0], axis=-1))
    jumped = np.array(moved) > 1e-4
    assert 0.9 < np.max(moved) <= 1.0 + 1e-5 and not jumped[:11].any()
    assert 0.8 * 120 / 66 < jumped.sum(0).mean() < 1.2 * 120 / 66  # every 2.2 s on average
