"""tracking.py: the table, what a row on the reference sees, where episodes start and end."""

from dataclasses import replace

import numpy as np
import pytest

from kinetok.config import ConfigError
from kinetok.sim.batch import BodyState
from kinetok.sim.tasks.tracking import Failure, ReferenceTable, Tracking, TrackingConfig, lengths

RNG = np.random.default_rng(0)


def make(table, rows, future=(0, 1, 40), failure=None, **kwargs) -> Tracking:
    return Tracking(TrackingConfig(future=future, failure=failure or Failure()), table, rows=rows, **kwargs)


def on_reference(table, task) -> BodyState:
    return table.body.rows(task.frame)


def begin(table, clips, starts, **kwargs):
    task = make(table, len(clips), fixed=np.array(clips), starts=np.array(starts), **kwargs)
    task.start(np.arange(len(clips)), RNG)
    return task


def frames(task, obs) -> np.ndarray:
    """The window as (N, F, P + 6)."""
    return obs[:, task.layout["window"]].reshape(len(obs), len(task.config.future), -1)


def test_table(table):
    # a loop of 30 steps unrolled by 60 more, and a clip of 15 steps that is not
    assert (table.cycle.tolist(), table.first.tolist(), table.last.tolist()) == ([30, 15], [0, 91], [90, 106])
    assert len(table.qpos) == len(table.target) == len(table.pose) == 107
    np.testing.assert_allclose(table.qpos[30:60, 2:], table.qpos[0:30, 2:], atol=1e-5)
    np.testing.assert_allclose(table.root[:91, 0], 0.3 * np.arange(91) / 30, atol=1e-4)


def test_a_loop_begins_and_ends_as_it_goes_on(table):
    np.testing.assert_allclose(table.qvel[0], table.qvel[30], atol=1e-4)
    np.testing.assert_allclose(table.qvel[90], table.qvel[60], atol=1e-4)
    np.testing.assert_allclose(table.body.linear[0], table.body.linear[30], atol=1e-4)


def test_target_leads_the_reference(table, humanoid):
    frame, u = 10, int(humanoid.hinge[0, 1])
    q, d = int(humanoid.hinge[0, 0]), int(humanoid.dof[u])
    speed = (table.qpos[frame + 1, q] - table.qpos[frame - 1, q]) * 15  # central difference at 30 Hz
    assert table.qvel[frame, d] == pytest.approx(speed, rel=1e-6) and abs(speed) > 0.1
    assert table.target[frame, u] == pytest.approx(table.qpos[frame, q] + 0.05 * speed, abs=1e-6)  # kd / kp = 0.05
    expected = humanoid.pose_to_ctrl(table.qpos[frame]) + 0.05 * table.qvel[frame, humanoid.dof]
    np.testing.assert_allclose(table.target[frame], expected, atol=1e-6)


def test_layout(table, humanoid):
    task = make(table, 1)
    stops = [0, 223, 223 + 3 * 138, 223 + 3 * 138 + 180, 223 + 3 * 138 + 180 + 28]
    assert [(s.start, s.stop) for s in task.layout.values()] == list(zip(stops, stops[1:], strict=False))
    assert list(task.layout) == ["state", "window", "error", "target"] and task.obs_size == stops[-1]


def test_a_row_on_the_reference(table):
    task = begin(table, [0, 0, 1], [7, 29, 3])
    obs = task.observe(on_reference(table, task))
    window = frames(task, obs)
    expected = np.stack([0 * task.frame, 0 * task.frame, 0 * task.frame, table.root[task.frame, 2]], axis=1)
    np.testing.assert_allclose(window[:, 0, -6:-2], expected, atol=1e-6)  # offset x, y, z and height
    np.testing.assert_allclose(window[:, 0, -2:], [[1, 0]] * 3, atol=1e-6)  # no relative heading
    np.testing.assert_allclose(window[:, 1, :-6], table.pose[task.frame + 1], atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(window[:, 1, -6:-4], axis=1), 0.01, atol=1e-3)  # 0.3 m/s for 1/30 s
    np.testing.assert_allclose(obs[:, task.layout["error"]], 0, atol=1e-6)
    np.testing.assert_array_equal(obs[:, task.layout["target"]], table.target[task.frame + 1])
    reward, terms = task.reward(on_reference(table, task))
    np.testing.assert_allclose(reward, 1.2, atol=1e-5)
    np.testing.assert_allclose(sum(terms.values()), reward)


def test_a_reference_beyond_the_leash_is_shown_at_its_end(table):
    """Three rows pushed to the left of their reference, by less than the leash, by more, and by far more."""
    task = begin(table, [0, 0, 0], [7, 7, 7])
    pushed = on_reference(table, task)
    pushed = replace(pushed, pos=pushed.pos + np.array([[0, 0.2, 0], [0, 0.31, 0], [0, 3, 0]], np.float32)[:, None])
    obs = task.observe(pushed)
    sideways = frames(task, obs)[:, :, -5]
    heading = table.heading[task.frame[0]]
    np.testing.assert_allclose(sideways[:, 0], -np.cos(heading) * np.array([0.2, 0.3, 0.3]), atol=1e-5)
    np.testing.assert_allclose(obs[2], obs[1], atol=1e-5)  # how much further it is makes no difference
    reward, _ = task.reward(pushed)
    assert reward[1] > reward[2] and task.over(pushed)[0].tolist() == [False, True, True]  # 0.3 m on average is too far


def test_the_window_holds_the_clips_end(table):
    task = begin(table, [0, 1], [89, 10])
    window = frames(task, task.observe(on_reference(table, task)))
    np.testing.assert_array_equal(window[:, 2, :-6], table.pose[[90, 106]])
    last = begin(table, [0, 1], [90, 15])
    window = frames(last, last.observe(on_reference(table, last)))
    np.testing.assert_array_equal(window[:, 1], window[:, 0])
    np.testing.assert_array_equal(window[:, 2], window[:, 0])


def test_rows_by_id(table):
    task = begin(table, [0, 1, 0, 1], [3, 4, 5, 6])
    ids = np.array([3, 0])
    body = on_reference(table, task)
    np.testing.assert_array_equal(task.observe(body.rows(ids), ids), task.observe(body)[ids])


def test_starts_are_uniform_over_the_cycle(table):
    task = make(table, 6000)
    qpos, qvel = task.start(np.arange(6000), np.random.default_rng(0))
    np.testing.assert_array_equal(qpos, table.qpos[task.frame])
    np.testing.assert_array_equal(qvel, table.qvel[task.frame])
    assert (task.clip == 1).mean() == pytest.approx(0.5, abs=0.03)
    for clip, cycle in enumerate(table.cycle):
        offsets = task.frame[task.clip == clip] - table.first[clip]
        counts = np.bincount(offsets, minlength=cycle)
        assert len(counts) == cycle and counts.min() > 0.5 * counts.mean()


def test_a_share_of_the_episodes_starts_at_the_first_frame(table):
    task = Tracking(TrackingConfig(from_start=0.5), table, rows=6000)
    task.start(np.arange(6000), np.random.default_rng(0))
    for clip, cycle in enumerate(table.cycle):
        first = task.frame[task.clip == clip] == table.first[clip]
        assert first.mean() == pytest.approx(0.5 + 0.5 / cycle, abs=0.03)


def test_a_share_of_more_than_all_is_refused():
    with pytest.raises(ConfigError, match="from_start is a share of the episodes, 0 to 1"):
        TrackingConfig(from_start=1.5)


def test_clips_that_fail_are_drawn_more_often(table):
    task = make(table, 4000)
    task.clip[:] = 1
    task.finished(np.arange(30), np.ones(30, dtype=bool))
    assert task.weights.values == pytest.approx([1.0, 0.98**-30])
    task.start(np.arange(4000), np.random.default_rng(0))
    assert (task.clip == 1).mean() == pytest.approx(0.98**-30 / (1 + 0.98**-30), abs=0.03)
    other = make(table, 1)
    other.load_state_dict(task.state_dict())
    np.testing.assert_array_equal(other.weights.values, task.weights.values)


def test_advance_and_over(table):
    task = begin(table, [0, 1], [0, 13])
    body = on_reference(table, task)
    assert [x.tolist() for x in task.over(body)] == [[False, False], [False, False]]
    task.advance()
    assert task.over(on_reference(table, task))[1].tolist() == [False, False]
    task.advance()
    assert task.over(on_reference(table, task))[1].tolist() == [False, True]
    task.advance()
    assert task.frame.tolist() == [3, 106]


def test_slack_forgives_where_the_root_is_and_nothing_else(table):
    """Rows moved by less than the slack, by more, moved and with a limb out of place, and lifted."""
    task = begin(table, [0, 0, 0, 0], [5, 5, 5, 5], failure=Failure(slack=2.0))
    body = on_reference(table, task)
    body.pos[:3, :, :2] += np.array([[1.0, -1.0], [2.0, 2.0], [1.0, 0.0]], np.float32)[:, None]
    body.pos[2, 3, 1] += 0.6
    body.pos[3, :, 2] += 0.6
    assert task.over(body)[0].tolist() == [False, True, True, True]
    np.testing.assert_allclose(lengths(task.offset[0]), np.sqrt(2), atol=1e-5)  # what is reported is the whole error


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mean": 0.0}, "mean must be above 0, not 0.0; its unit is metres"),
        ({"largest": -1.0}, "largest must be above 0, not -1.0"),
        ({"slack": -0.1}, "slack is metres that the root may be away by, 0 for none; not -0.1"),
    ],
)
def test_failures_that_end_every_episode_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        Failure(**settings)


@pytest.mark.parametrize(
    ("bodies", "distance", "fails"),
    [(15, 0.29, False), (15, 0.31, True), (1, 0.49, False), (1, 0.51, True), (1, np.nan, True)],
)
def test_failure_by_mean_and_by_largest_error(table, bodies, distance, fails):
    task = begin(table, [0], [5])
    body = on_reference(table, task)
    body.pos[0, -bodies:, 1] += distance
    assert task.over(body)[0].tolist() == [fails]
    if np.isfinite(distance):
        assert lengths(task.offset[0]).max() == pytest.approx(distance, abs=1e-5)


def test_a_table_that_memory_cannot_hold_is_refused_before_it_is_filled(library, monkeypatch):
    table = ReferenceTable(library)
    columns = (table.qpos, table.qvel, table.pose, table.target, table.heading, *vars(table.body).values())
    machine = {"SC_PHYS_PAGES": 100, "SC_PAGE_SIZE": sum(x.nbytes for x in columns if x is not None) // 100}
    monkeypatch.setattr("os.sysconf", machine.__getitem__)
    with pytest.raises(ConfigError, match=r"hours of reference frames take 0\.0 GB, and this machine has .*--hours 1"):
        ReferenceTable(library)
    machine["SC_PHYS_PAGES"] = 130
    assert len(ReferenceTable(library).qpos) == len(table.qpos)
