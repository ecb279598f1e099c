"""roaming.py: how a row changes from one clip to another, and episodes that begin as if it had."""

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.observe import state_features
from kinetok.sim.tasks.roaming import Arriving, Roaming, likeness, moved
from kinetok.sim.tasks.tracking import ReferenceTable, TrackingConfig


def standing(humanoid, name: str, frames: int, x: float, yaw: float) -> Clip:
    qpos = np.tile(humanoid.model.qpos0, (frames, 1))
    qpos[:, 0], qpos[:, 2] = x, 0.89
    qpos[:, 3:7] = rotation.about_z(np.full(frames, yaw))
    return Clip(name=name, character="humanoid", fps=30.0, qpos=qpos)


@pytest.fixture(scope="module")
def two_stands(humanoid) -> ReferenceTable:
    clips = [standing(humanoid, "here", 11, 0.0, 0.0), standing(humanoid, "there", 11, 5.0, 1.5)]
    return ReferenceTable(ClipLibrary.of(clips), control_hz=30)


def roaming(table, rows, **settings):
    """A task of the table and its environment, reset."""
    settings = {"transitions": 0.0, "rng": np.random.default_rng(0)} | settings
    task = Roaming(TrackingConfig(future=(1, 2)), table, rows=rows, **settings)
    env = Env(EnvConfig(), task, rows=rows, threads=1)
    return task, env, env.reset()


def test_physics_cannot_tell_that_a_state_was_moved(humanoid):
    # In flight: the scene's friction pyramid is square, so that sliding depends a little on the heading.
    rng = np.random.default_rng(0)
    qpos = np.tile(humanoid.model.qpos0, (4, 1))
    qpos[:, :2], qpos[:, 2] = rng.normal(size=(4, 2)), 3.0
    qpos[:, 3:7] = rotation.from_rotvec(0.3 * rng.standard_normal((4, 3)))
    qvel = rng.standard_normal((4, humanoid.nv))
    heading = rng.uniform(-3, 3, 4)
    there = moved(qpos, qvel, np.full((4, 2), 7.0), heading)
    np.testing.assert_allclose(there[0][:, :2], 7.0)
    np.testing.assert_allclose(np.exp(1j * rotation.heading(there[0][:, 3:7])), np.exp(1j * heading))
    features = []
    for state in ((qpos, qvel), there):
        _, env, _ = roaming(ReferenceTable(ClipLibrary.of([standing(humanoid, "s", 9, 0, 0)])), 4)
        env.sim.set_state(np.arange(4), *state)
        told = [state_features(env.sim.state())]
        for _ in range(5):
            env.sim.step(np.zeros((4, humanoid.nu)), 4)
            told.append(state_features(env.sim.state()))
        features.append(np.stack(told))
    np.testing.assert_allclose(features[0], features[1], atol=1e-4)


def test_likeness_is_a_distance_in_metres_blind_to_place_and_heading(two_stands):
    body = two_stands.body
    here, there = likeness(body.rows(np.array([0]))), likeness(body.rows(np.array([two_stands.first[1]])))
    assert np.linalg.norm(here - there) < 1e-5
    lower = body.rows(np.array([0]))
    lower.pos[..., 2] -= 0.1
    assert np.linalg.norm(likeness(lower) - here) == pytest.approx(0.1, abs=1e-5)


def test_a_clip_that_ends_goes_on_in_one_that_is_alike(two_stands, humanoid):
    task, env, obs = roaming(two_stands, 16)
    hold = np.zeros((16, humanoid.nu))
    clips, landed = [task.clip.copy()], 0
    for _ in range(20):
        step = env.step(hold)
        obs = step.obs
        going = np.flatnonzero(task.landing >= 0)
        before = state_features(env.sim.state())
        frames = task.landing[going]
        task.land(env, obs)
        landed += len(going)
        # the state is the same, and root and reference now agree
        np.testing.assert_allclose(state_features(env.sim.state())[going], before[going], atol=1e-4)
        np.testing.assert_allclose(env.sim.qpos[going, :2], two_stands.root[frames, :2], atol=1e-6)
        np.testing.assert_array_equal(task.frame[going], frames)
        np.testing.assert_array_equal(obs, task.observe(env.sim.state()))
        assert not step.truncated.any() and not step.terminated.any()
        clips.append(task.clip.copy())
    assert landed > 16 and (np.diff(clips, axis=0) != 0).any()
    assert (task.landing == -1).all()


def test_without_a_like_frame_the_end_is_the_end(two_stands, humanoid):
    task, env, _ = roaming(two_stands, 8, reach=0.0, reach_at_end=0.0)
    steps = [env.step(np.zeros((8, humanoid.nu))) for _ in range(12)]
    assert all((task.landing == -1).all() for _ in steps) and any(step.truncated.any() for step in steps)


@pytest.fixture(scope="module")
def sinking(humanoid) -> ReferenceTable:
    """0.5 m down in 2 s: neighbouring frames are 8 mm apart."""
    clip = standing(humanoid, "sinking", 61, 0.0, 0.0)
    clip.qpos[:, 2] -= np.linspace(0, 0.5, 61)
    return ReferenceTable(ClipLibrary.of([clip]), control_hz=30)


def placed(table, frame: int, **settings):
    """A task and its environment of 4 rows exactly at a frame of the first clip."""
    task, env, obs = roaming(table, 4, **settings)
    rows, frames = np.arange(4), np.full(4, frame)
    task.place(rows, np.zeros(4, int), frames)
    env.sim.set_state(rows, table.qpos[frames], table.qvel[frames])
    return task, env, obs


def test_a_clip_is_not_entered_again_just_behind(sinking):
    """The likest frames of all are those just passed, and a motion that went back to them would stutter."""
    task, env, _ = placed(sinking, 60)
    task.over(env.sim.state())
    assert (task.landing == 60 - task.tail).all()
    task, env, _ = placed(sinking, 59)
    for _ in range(9):  # one step is left: every row looks for a frame with certainty
        task.over(env.sim.state())
        assert (task.landing == 59 - task.tail).all()


def test_an_end_that_is_like_nothing_may_go_on_in_the_likest_frame(sinking):
    task, env, _ = placed(sinking, 60, reach=0.0, reach_at_end=0.05)  # the likest is 17 mm away
    terminated, over = task.over(env.sim.state())
    assert not terminated.any() and not over.any() and (task.landing == 58).all()
    for frame, reach in ((60, 0.01), (59, 0.05)):  # too far; not yet at the end
        task, env, _ = placed(sinking, frame, reach=0.0, reach_at_end=reach)
        _, over = task.over(env.sim.state())
        assert (task.landing == -1).all() and over.all() == (frame == 60)


def test_after_a_jump_the_error_counts_when_the_body_had_time_to_come_over(sinking):
    task, env, obs = placed(sinking, 60, reach=0.0, reach_at_end=0.05)
    task.over(env.sim.state())
    task.land(env, obs)
    far = env.sim.qpos.copy()
    far[:3, 0] += 2.0
    env.sim.set_state(np.arange(4), far, env.sim.qvel)
    body = env.sim.state(np.arange(4))
    body.pos[2] = np.nan  # as in a simulation that blew up
    failed = [task.over(body)[0] for _ in range(11)]
    assert [step.tolist() for step in failed[:9]] == [[False, False, True, False]] * 9  # 0.3 s
    assert [step.tolist() for step in failed[9:]] == [[True, True, True, False]] * 2
    env.reset()
    assert not task.over(env.sim.state())[0].any() and task.over(body)[0].all()  # a row that starts has no such time


def test_transitions_happen_at_random_and_only_to_other_clips(humanoid):
    clips = [standing(humanoid, "here", 301, 0, 0), standing(humanoid, "there", 301, 5, 1.5)]
    table = ReferenceTable(ClipLibrary.of(clips), control_hz=30)
    task, env, obs = roaming(table, 32, transitions=3.0)  # 32 rows, 15 steps: 48 expected
    moves = 0
    for _ in range(15):
        clip = task.clip.copy()
        obs = env.step(np.zeros((32, humanoid.nu))).obs
        going = (task.landing >= 0) & (table.last[clip] - task.frame > task.tail)
        task.land(env, obs)
        assert (task.clip[going] != clip[going]).all()
        moves += going.sum()
    assert 25 < moves < 80


def test_a_share_of_the_episodes_begins_in_states_of_other_clips(humanoid, sinking):
    """States of a body that sinks from 0.89 to 0.39 m, of which those within 0.1 m of standing are let in."""
    stand = ReferenceTable(ClipLibrary.of([standing(humanoid, "here", 31, 5.0, 1.5)]))
    task = Arriving(TrackingConfig(future=(1, 2)), stand, sinking, rows=400, share=0.5, reach=0.1)
    env = Env(EnvConfig(), task, rows=400, threads=1)
    env.reset()
    low = 0.89 - env.sim.qpos[:, 2]
    arrived = low > 1e-3
    assert 120 < arrived.sum() < 280 and low.max() < 0.1 + 1e-6 and low.max() > 0.05
    np.testing.assert_allclose(env.sim.qpos[:, :2], task.table.root[task.frame, :2], atol=1e-6)
    assert (task.grace[arrived] > 0).all() and (task.grace[low < 0] == 0).all()
    alone = Arriving(TrackingConfig(future=(1, 2)), stand, sinking, rows=4, share=0.5, reach=1e-6)
    assert alone.share == 0 and not len(alone.sources)  # the sinking body moves from its first frame on
