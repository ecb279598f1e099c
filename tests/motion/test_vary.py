"""vary.py: paths that bend, tempos that wander, halts, and what is refused."""

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import kinematics, lowest_point
from kinetok.motion.vary import FPS, standing, vary


def glide(humanoid, **fields) -> Clip:
    """A standing body carried along x at 1 m/s."""
    qpos = np.tile(humanoid.stand(), (31, 1))
    qpos[:, 0] = np.arange(31) / 30
    return Clip(**({"name": "glide", "character": "humanoid", "fps": 30.0, "qpos": qpos, "loop": True} | fields))


def test_without_changes_the_motion_is_the_same(humanoid):
    varied = vary(glide(humanoid), seconds=5, turn=0, tempo=1)
    assert not varied.loop and varied.fps == FPS and varied.name == "glide-varied"
    np.testing.assert_allclose(varied.qpos, glide(humanoid).at(np.arange(300) / FPS), atol=1e-9)


def test_the_path_bends_as_the_heading_does_and_the_body_leans_inwards(humanoid):
    varied = vary(glide(humanoid), seconds=20, turn=90, tempo=1, seed=1)
    heading = np.unwrap(rotation.heading(varied.qpos[:, 3:7]))
    rate = np.gradient(heading) * FPS
    assert np.radians(60) < np.abs(rate).max() < np.radians(91)
    up = rotation.rotate(varied.qpos[:, 3:7], np.array([0.0, 0.0, 1.0]))
    left = np.stack([-np.sin(heading), np.cos(heading), 0 * heading], axis=1)
    lean = np.arcsin((up * left).sum(1))
    np.testing.assert_allclose(lean, np.arctan(rate / 9.81), atol=5e-3)  # at 1 m/s
    floor = varied.qpos[:, :3] - up * humanoid.stand()[2]  # the point that leans stays on the path
    step = np.diff(floor[:, :2], axis=0)
    np.testing.assert_allclose(np.linalg.norm(step, axis=1) * FPS, 1.0, atol=1e-3)
    np.testing.assert_allclose(
        np.unwrap(np.arctan2(step[:, 1], step[:, 0])), (heading[1:] + heading[:-1]) / 2, atol=2e-3
    )


def test_the_tempo_stays_within_its_factor(humanoid):
    varied = vary(glide(humanoid), seconds=30, turn=0, tempo=1.5)
    speed = np.diff(varied.qpos[:, 0]) * FPS
    assert 1 / 1.5 - 1e-6 < speed.min() < 0.8 and 1.25 < speed.max() < 1.5 + 1e-6


def test_a_walk_goes_over_into_standing_without_turning_there(walk, humanoid):
    varied = vary(walk, seconds=60, turn=70, into=standing(walk))
    speed = np.linalg.norm(np.diff(varied.qpos[:, :2], axis=0), axis=1) * FPS
    assert 0.05 < (speed < 0.01).mean() < 0.6 and speed.max() > 0.9
    turn = np.abs(np.diff(np.unwrap(rotation.heading(varied.qpos[:, 3:7])))) * FPS
    assert turn[speed < 0.01].max() < 0.1 and turn[speed > 0.9].max() > 0.4
    low = lowest_point(humanoid, varied.qpos)
    assert low.min() > -1e-3 and low.max() < 0.03


def test_a_shorter_change_halts_more_often(walk):
    def halts(change: float) -> int:
        varied = vary(walk, turn=0, into=standing(walk), change=change)
        speed = np.linalg.norm(np.diff(varied.qpos[:, :2], axis=0), axis=1)
        return int((np.diff((speed * FPS < 0.05).astype(int)) == 1).sum())

    assert halts(1.0) > 2 * halts(3.0) > 0


def test_a_walk_halts_with_both_feet_on_the_floor(walk, humanoid):
    varied = vary(walk, seconds=40, turn=0, tempo=1, halt=2)
    motion = kinematics(humanoid, varied.qpos, FPS)
    still = np.linalg.norm(motion.linear, axis=-1).max(1) < 1e-6
    assert 0.1 < still.mean() < 0.6
    feet = motion.xpos[still][:, humanoid.bodies("feet"), 2]
    assert (feet < motion.xpos[:, humanoid.bodies("feet"), 2].min() + 0.1).all()
    assert lowest_point(humanoid, varied.qpos).min() > -0.01
    jerk = np.linalg.norm(np.diff(motion.linear[:, 0], axis=0), axis=1).max() * FPS
    calm = kinematics(humanoid, walk.at(np.arange(600) / FPS), FPS).linear[:, 0]
    assert jerk < 3 * np.linalg.norm(np.diff(calm, axis=0), axis=1).max() * FPS  # a stop is no collision


def test_the_same_seed_gives_the_same_motion(walk):
    first, same, other = (vary(walk, seconds=4, halt=1, seed=seed).qpos for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - other).max() > 0.1


def test_a_clip_that_is_no_loop_ends_where_it_ends(humanoid):
    varied = vary(glide(humanoid, loop=False), seconds=60, turn=30, tempo=1.2)
    assert 0.7 < varied.seconds < 1.3


def test_what_is_refused(humanoid):
    with pytest.raises(ValueError, match=r"no moment to halt at: its fastest foot never moves slower than 1.00 m/s"):
        vary(glide(humanoid), halt=2)
    with pytest.raises(ValueError, match=r"tempo at least 1, change at least 0.5; not 60.0, 60.0, 0.0, 0.5, 3.0"):
        vary(glide(humanoid), tempo=0.5)


def test_a_walk_goes_over_into_a_jog_in_step(walk, jog, humanoid):
    varied = vary(walk, into=jog, seconds=60, turn=0, tempo=1, seed=3)
    assert varied.name == f"{walk.name}-{jog.name}-varied" and not varied.loop
    speed = np.convolve(np.diff(varied.qpos[:, 0]) * FPS, np.ones(60) / 60, "valid")
    ends = [np.hypot(*(clip.qpos[-1, :2] - clip.qpos[0, :2])) / clip.seconds for clip in (walk, jog)]
    assert speed.min() == pytest.approx(ends[0], rel=0.15) and speed.max() == pytest.approx(ends[1], rel=0.15)
    motion = kinematics(humanoid, varied.qpos, FPS)
    right, left = (motion.xpos[:, foot, 0] for foot in humanoid.bodies("feet"))
    strides = [np.ptp((left - right)[t : t + 80]) for t in range(0, len(left) - 80, 20)]
    assert min(strides) > 1.0  # a walk's is 1.2 m; out of step the two would take from one another
    assert lowest_point(humanoid, varied.qpos).min() > -0.03


def test_only_loops_of_one_body_go_over_into_one_another(walk):
    with pytest.raises(ValueError, match=r"both must be loops of one character, and halt 0; .* loop True and False"):
        vary(walk, into=vary(walk, seconds=2))
