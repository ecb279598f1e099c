"""style.py: another walker, on his feet, the same on both sides, never the same twice."""

from dataclasses import replace

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.kinematics import kinematics, lowest_point
from kinetok.motion.style import FPS, TEMPO, restyle
from kinetok.motion.vary import standing, vary


def slide(body, clip, plain) -> float:
    """Mean horizontal speed of the ankle that is the lower one in the plain gait."""
    feet = body.bodies("feet")
    lower = kinematics(body, plain.qpos, FPS).xpos[:, feet, 2].argmin(1)
    motion = kinematics(body, clip.qpos, clip.fps)
    return float(np.linalg.norm(motion.linear[np.arange(len(lower)), np.array(feet)[lower], :2], axis=1).mean())


def test_no_amount_changes_nothing(walk):
    same = restyle(walk, amount=0)
    np.testing.assert_allclose(same.qpos[:, :3], walk.at(np.arange(len(same.qpos)) / FPS)[:, :3], atol=5e-3)
    assert (
        same.loop and same.fps == pytest.approx(FPS, rel=0.02) and same.seconds == pytest.approx(walk.seconds, rel=0.01)
    )


def test_styles_differ_and_are_seeded(walk):
    one, again, other = (restyle(walk, seed=seed).qpos for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one[:, 7:] - other[:, 7:]).max() > 0.1


@pytest.mark.parametrize("seed", range(4))
def test_a_styled_walk_stands_on_level_feet_and_keeps_on(walk, humanoid, seed):
    plain, styled = restyle(walk, amount=0), restyle(walk, seed=seed)
    assert abs(lowest_point(humanoid, styled.qpos) - lowest_point(humanoid, plain.qpos)).max() < 1e-6
    assert slide(humanoid, styled, plain) < 1.5 * slide(humanoid, plain, plain)
    feet = humanoid.bodies("feet")
    soles = [kinematics(humanoid, clip.qpos, FPS).xquat[:, feet] for clip in (plain, styled)]
    np.testing.assert_allclose(np.abs((soles[0] * soles[1]).sum(-1)), 1, atol=1e-9)
    way = styled.qpos[-1, :2] - styled.qpos[0, :2]
    forwards = plain.qpos[-1, :2] - plain.qpos[0, :2]
    assert 0.6 < np.linalg.norm(way) / np.linalg.norm(forwards) < 1.4
    assert abs(forwards[0] * way[1] - forwards[1] * way[0]) / (forwards @ way) < 0.02  # straight ahead
    assert 1 / TEMPO <= styled.fps / plain.fps <= TEMPO
    np.testing.assert_allclose(styled.qpos[-1, 7:], styled.qpos[0, 7:], atol=0.06)  # still a cycle


def test_both_sides_change_alike(walk, humanoid):
    """The mean pose of a symmetric gait stays symmetric."""
    both = walk.qpos[:1].repeat(31, 0)
    both[:, :2] = 0
    still = replace(walk, qpos=both * 0 + humanoid.stand(), fps=30.0)
    styled = restyle(still, amount=1.0, seed=3).qpos
    image = humanoid.mirror_qpos(styled)
    quats = [q[:, 7:11] for q in (styled, image)]
    np.testing.assert_allclose(np.abs((quats[0] * quats[1]).sum(-1)), 1, atol=1e-3)
    angle = np.linalg.norm(rotation.to_rotvec(styled[:, 3:7]), axis=-1)
    assert angle.max() < 0.3 and not np.allclose(styled[:, 7:], still.qpos[:1, 7:], atol=1e-3)


def test_both_sides_swing_as_much_more_or_less(walk, humanoid):
    plain, styled = (humanoid.pose_to_ctrl(restyle(walk, amount=amount, seed=5).qpos) for amount in (0, 0.5))
    hinges = humanoid.hinge[:, 1]
    ratio = np.ptp(styled[:, hinges], axis=0) / np.ptp(plain[:, hinges], axis=0)
    names = [humanoid.body_names[humanoid.model.dof_bodyid[humanoid.dof[u]] - 1] for u in hinges]
    by_name = dict(zip(names, ratio, strict=True))
    assert by_name["left_shin"] == pytest.approx(by_name["right_shin"], rel=0.02)
    assert by_name["left_lower_arm"] == pytest.approx(by_name["right_lower_arm"], rel=0.02)
    assert by_name["left_shin"] != pytest.approx(by_name["left_lower_arm"], rel=0.02) and abs(ratio - 1).max() > 0.05


def test_a_styled_stand_stands(walk):
    """So that `vary` knows it when a styled walk goes over into it."""
    stand = restyle(standing(walk), seed=2)
    assert np.ptp(stand.qpos[:, :2]) < 1e-9 and np.ptp(stand.qpos, axis=0).max() < 1e-9
    varied = vary(restyle(walk, seed=2), seconds=40, turn=70, into=stand)
    speed = np.linalg.norm(np.diff(varied.qpos[:, :2], axis=0), axis=1) * FPS
    turn = np.abs(np.diff(np.unwrap(rotation.heading(varied.qpos[:, 3:7])))) * FPS
    assert 0.02 < (speed < 0.01).mean() < 0.6 and turn[speed < 0.01].max() < 0.1


def test_what_cannot_be_styled_is_refused(walk):
    with pytest.raises(ValueError, match="'walk': a style needs a loop"):
        restyle(replace(walk, loop=False))
    with pytest.raises(ValueError, match="at least 0, not -1"):
        restyle(walk, amount=-1)
