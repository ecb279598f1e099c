"""batch.py against a loop of single simulations; velocities against MuJoCo; failures are reported and contained."""

import mujoco
import numpy as np
import pytest

from kinetok.motion.character import Character
from kinetok.sim.batch import FEW, BatchSim
from kinetok.sim.scene import SceneConfig, build_scene

ROWS, SUBSTEPS = 5, 4


@pytest.fixture(scope="module")
def scene():
    return build_scene(Character.load("humanoid"), SceneConfig())


def start(scene, seed=0):
    rng = np.random.default_rng(seed)
    qpos = np.tile(scene.qpos0, (ROWS, 1))
    qpos[:, 2] = 0.85 + 0.02 * np.arange(ROWS)
    return qpos, 0.3 * rng.standard_normal((ROWS, scene.nv)), 0.3 * rng.standard_normal((6, ROWS, scene.nu))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_loop_of_single_simulations(scene, threads):
    qpos, qvel, ctrl = start(scene)
    sim = BatchSim(scene, ROWS, threads)
    sim.set_state(np.arange(ROWS), qpos, qvel)
    worlds = [mujoco.MjData(scene) for _ in range(ROWS)]
    for data, q, v in zip(worlds, qpos, qvel, strict=True):
        data.qpos[:], data.qvel[:] = q, v
    for step in ctrl:
        assert sim.step(step, SUBSTEPS).size == 0
        for data, u in zip(worlds, step, strict=True):
            data.ctrl[:] = u
            mujoco.mj_step(scene, data, SUBSTEPS)
    np.testing.assert_array_equal(sim.qpos, [data.qpos for data in worlds])
    np.testing.assert_array_equal(sim.qvel, [data.qvel for data in worlds])
    assert any(data.ncon for data in worlds)  # the comparison covers contact


def test_body_state_is_fresh_and_mujocos_own(scene):
    qpos, qvel, ctrl = start(scene)
    sim, data, six = BatchSim(scene, ROWS, 1), mujoco.MjData(scene), np.zeros(6)
    sim.set_state(np.arange(ROWS), qpos, qvel)
    for when in ("after set_state", "after step"):
        if when == "after step":
            sim.step(ctrl[0], SUBSTEPS)
        state = sim.state()
        for row in range(ROWS):
            data.qpos[:], data.qvel[:] = sim.qpos[row], sim.qvel[row]
            mujoco.mj_forward(scene, data)
            np.testing.assert_allclose(state.pos[row], data.xpos[1:], atol=1e-6, err_msg=when)
            np.testing.assert_allclose(state.mat[row].reshape(-1, 9), data.xmat[1:], atol=1e-6, err_msg=when)
            np.testing.assert_allclose(state.quat[row], data.qpos[3:7], atol=1e-6)
            for body in range(1, scene.nbody):
                mujoco.mj_objectVelocity(scene, data, mujoco.mjtObj.mjOBJ_XBODY, body, six, 0)
                np.testing.assert_allclose(state.angular[row, body - 1], six[:3], atol=1e-5, err_msg=when)
                np.testing.assert_allclose(state.linear[row, body - 1], six[3:], atol=1e-5, err_msg=when)
    some = sim.state(np.array([3, 1]))
    for name in ("pos", "mat", "linear", "angular", "quat"):
        np.testing.assert_array_equal(getattr(some, name), getattr(state.rows(np.array([3, 1])), name))


def test_rows_divided_among_threads_are_the_same_bits(scene):
    rows, rng = 3 * FEW + 1, np.random.default_rng(0)
    qpos, qvel = np.tile(scene.qpos0, (rows, 1)), rng.standard_normal((rows, scene.nv))
    qpos[:, 7:] += 0.3 * rng.standard_normal((rows, scene.nq - 7))
    one, two = BatchSim(scene, rows, 1), BatchSim(scene, rows, 2)
    seen = []
    for sim in (one, two):
        sim.set_state(np.arange(rows), qpos, qvel)
        told = np.full((rows, scene.nbody - 1, 3), np.nan)
        sim.step(np.zeros((rows, scene.nu)), SUBSTEPS, lambda part, body, told=told: np.copyto(told[part], body.pos))
        np.testing.assert_array_equal(told, sim.state().pos)  # every row was looked at, fresh
        seen.append(told)
    np.testing.assert_array_equal(*seen)
    for name, values in vars(one.state()).items():
        np.testing.assert_array_equal(values, getattr(two.state(), name))
    some, other, now = one.state(np.array([3])), one.state().pos[4:].copy(), one.state()
    one.set_state(np.array([3]), qpos[:1], qvel[:1])
    assert not np.array_equal(now.pos[3], some.pos[0])  # all rows are seen as they are, some as they were
    np.testing.assert_array_equal(now.pos[4:], other)


@pytest.mark.parametrize("velocity", [np.nan, np.inf, 1e12])
def test_a_blown_up_row_is_reported_and_contained(scene, velocity, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log file where it stands
    qpos, qvel, ctrl = start(scene)
    good, bad = BatchSim(scene, ROWS, 2), BatchSim(scene, ROWS, 2)
    for sim in (good, bad):
        sim.set_state(np.arange(ROWS), qpos, qvel)
    bad.qvel[2, 9] = velocity
    assert good.step(ctrl[0], SUBSTEPS).tolist() == []
    assert bad.step(ctrl[0], SUBSTEPS).tolist() == [2]
    others = [0, 1, 3, 4]
    np.testing.assert_array_equal(bad.qpos[others], good.qpos[others])
    np.testing.assert_array_equal(bad.state().linear[others], good.state().linear[others])
    bad.set_state(np.array([2]), good.qpos[[2]], good.qvel[[2]])
    assert bad.step(ctrl[1], SUBSTEPS).size == 0  # the next step reports nothing old
    assert np.isfinite(bad.qpos).all()


def test_add_velocity_changes_the_roots_linear_velocity_only(scene):
    qpos, qvel, _ = start(scene)
    sim = BatchSim(scene, ROWS, 1)
    sim.set_state(np.arange(ROWS), qpos, qvel)
    sim.add_velocity(np.array([1, 3]), np.array([[1.0, 2.0, 0.0], [-1.0, 0.0, 0.5]]))
    expected = qvel.copy()
    expected[[1, 3], :3] += [[1.0, 2.0, 0.0], [-1.0, 0.0, 0.5]]
    np.testing.assert_array_equal(sim.qvel, expected)


def slide(sim, scene) -> np.ndarray:
    qpos = np.tile(scene.qpos0, (ROWS, 1))
    qpos[:, 2] = 0.87
    qvel = np.zeros((ROWS, scene.nv))
    qvel[:, 0] = 1.0
    sim.set_state(np.arange(ROWS), qpos, qvel)
    sim.step(np.zeros((ROWS, scene.nu)), 40)
    return sim.qpos[:, 0].copy()


def test_friction_of_the_floor_counts(scene):
    sim = BatchSim(scene, ROWS, 1)
    sim.set_friction(np.array([0.01, 0.1, 0.5, 1.0, 2.0]))
    travel = slide(sim, scene)
    assert (np.diff(travel[:3]) < -0.01).all(), travel  # below the feet's own friction of 1, too
    assert slide(BatchSim(build_scene(Character.load("humanoid"), SceneConfig(friction=0.1)), ROWS, 1), scene)[
        0
    ] == pytest.approx(travel[1], abs=1e-6)


def test_set_state_forgets_what_the_row_did_before(scene):
    qpos, qvel, ctrl = start(scene)
    fresh, used = BatchSim(scene, ROWS, 1), BatchSim(scene, ROWS, 1)
    for step in ctrl:
        used.step(step, SUBSTEPS)
    for sim in (fresh, used):
        sim.set_state(np.arange(ROWS), qpos, qvel)
        sim.step(ctrl[0], SUBSTEPS)
    np.testing.assert_array_equal(used.qvel, fresh.qvel)
