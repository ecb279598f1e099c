"""upright.py: no lying starts, falls end an episode, the plane as the root sees it."""

from dataclasses import replace

import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.rotation import heading
from kinetok.sim import observe
from kinetok.sim.tasks.upright import Upright, check_ranges, in_heading
from tests.sim.tasks.planar import body_at, standing


def make(humanoid, qpos, qvel, rows=3, starts=None, fall_height=0.5) -> Upright:
    return Upright(humanoid, qpos, qvel, rows=rows, starts=starts, fall_height=fall_height, numbers=2)


def test_the_plane_from_a_heading():
    # heading along y: the world's x is to the right, its y ahead
    quat = body_at([[0, 0]], angle=np.pi / 2).quat
    np.testing.assert_allclose(in_heading(np.array([[1.0, 0.0]]), heading(quat)), [[0, -1]], atol=1e-7)
    np.testing.assert_allclose(
        in_heading(np.array([[[0.0, 1.0], [2.0, 3.0]]]), heading(quat)), [[[1, 0], [3, -2]]], atol=1e-6
    )


def test_the_state_comes_first(humanoid):
    world = make(humanoid, *standing(humanoid, 2))
    body = body_at([[0, 0], [1, 2], [3, 4]], angle=0.3)
    obs, task = world.blank(body)
    task[:] = 7
    assert world.layout == {"state": slice(0, 223), "task": slice(223, 225)} and obs.shape == (3, world.obs_size)
    np.testing.assert_array_equal(obs[:, world.layout["state"]], observe.state_features(body))
    assert (obs[:, 223:] == 7).all()


def test_a_fall_is_a_failure_and_so_is_a_broken_state(humanoid):
    world = make(humanoid, *standing(humanoid, 2))
    world.start(np.arange(3), np.random.default_rng(0))
    body = body_at([[0, 0], [1, 2], [3, 4]], height=[0.51, 0.49, 0.9])
    broken = replace(body, pos=body.pos.copy())
    broken.pos[2, 0, 0] = np.nan
    terminated, truncated = world.over(broken)
    assert terminated.tolist() == [False, True, True] and not truncated.any()
    np.testing.assert_array_equal(world.root[:2], body.pos[:2, 0])
    assert np.isfinite(world.root).all()  # a new target can still be placed around it


def test_lying_starts_are_refused_unless_they_are_not_used(humanoid):
    qpos, qvel = standing(humanoid, 4)
    qpos[[1, 3], 2] = 0.2
    with pytest.raises(ValueError, match=r"2 of 4 start states, first 1, have their root below fall_height 0.5 m"):
        make(humanoid, qpos, qvel)
    with pytest.raises(ValueError, match="1 of 4 start states, first 3"):
        make(humanoid, qpos, qvel, starts=np.array([0, 2, 3]))
    make(humanoid, qpos, qvel, starts=np.array([0, 2, 0]))
    make(humanoid, qpos, qvel, fall_height=0.1)


def test_ranges():
    check_ranges(seconds=(1.0, 1.0))
    for bad in ((2.0, 1.0), (0.0, 1.0)):
        with pytest.raises(ConfigError, match="speed must be two positive numbers in order"):
            check_ranges(speed=bad)
