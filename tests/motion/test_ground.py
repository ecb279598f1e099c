"""ground.py: a floor that sinks and rises is found again, and flight is not."""

import numpy as np
import pytest

from kinetok.motion.formats import read_clips
from kinetok.motion.ground import floor_height
from kinetok.motion.kinematics import lowest_point

FPS = 60.0


def standing(humanoid, seconds: float) -> np.ndarray:
    """A figure that stands still on the floor."""
    qpos = np.tile(humanoid.model.qpos0, (round(seconds * FPS), 1))
    qpos[:, 2] -= lowest_point(humanoid, qpos[:1])
    return qpos


def test_a_floor_that_moves_slowly_is_found(humanoid):
    qpos = standing(humanoid, 4)
    times = np.arange(len(qpos)) / FPS
    moved = 0.3 + 0.06 * np.sin(2 * np.pi * times / 4)
    qpos[:, 2] += moved
    np.testing.assert_allclose(floor_height(humanoid, qpos, FPS), moved, atol=0.005)


@pytest.mark.parametrize("rise", [0.05, 0.25])
def test_a_leap_keeps_its_height_over_a_floor_on_which_it_lands_higher(humanoid, rise):
    qpos = standing(humanoid, 3)
    times = np.arange(len(qpos)) / FPS
    speed = np.sqrt(2 * 9.81 * rise)
    flight = 2 * speed / 9.81
    since = np.clip(times - 1, 0, flight)
    leap = speed * since - 9.81 / 2 * since**2
    floor = 0.04 * np.clip((times - 1) / flight, 0, 1)
    qpos[:, 2] += leap + floor
    found = floor_height(humanoid, qpos, FPS)
    np.testing.assert_allclose(found, floor, atol=0.02)
    assert (leap + floor - found).max() == pytest.approx(rise, abs=0.02)


def test_of_a_loop_it_is_a_loop(humanoid):
    qpos = standing(humanoid, 2)
    qpos[:, 2] += 0.05 * np.sin(np.linspace(0, 2 * np.pi, len(qpos)))
    found = floor_height(humanoid, qpos, FPS, loop=True)
    assert found[0] == pytest.approx(found[-1], abs=1e-9)
    np.testing.assert_allclose(found, qpos[:, 2] - standing(humanoid, 2)[:, 2], atol=0.005)


def test_recorded_figures_neither_hover_nor_lose_their_leaps(humanoid, data_dir):
    """Before: stealthy_walk, roll and dance_b hovered by 5 to 6 cm in the median; run and spinkick fly."""
    for name in ("stealthy_walk", "roll", "dance_b", "getup_faceup", "spin"):
        (clip,) = read_clips(data_dir / f"train/deepmimic/humanoid3d_{name}.txt")
        assert abs(np.median(lowest_point(humanoid, clip.qpos))) < 0.006, name
    for name, rise in (("run", 0.1), ("jump", 0.2), ("spinkick", 0.4), ("backflip", 0.3)):
        (clip,) = read_clips(data_dir / f"train/deepmimic/humanoid3d_{name}.txt")
        assert lowest_point(humanoid, clip.qpos).max() > rise, name
