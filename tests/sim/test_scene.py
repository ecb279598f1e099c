"""scene.py: the character on a floor, at the rates and friction asked for."""

import mujoco
import pytest

from kinetok.sim.scene import SceneConfig, build_scene


def test_scene(humanoid):
    model = build_scene(humanoid, SceneConfig(control_hz=50, substeps=2, iterations=7, friction=0.3))
    assert (model.nq, model.nu, model.nbody) == (humanoid.nq, humanoid.nu, humanoid.model.nbody)
    assert model.opt.timestep == pytest.approx(0.01) and model.opt.iterations == 7
    assert model.geom_type[0] == mujoco.mjtGeom.mjGEOM_PLANE and model.geom_friction[0, 0] == pytest.approx(0.3)
    assert model.jnt_bodyid[0] == 1  # bodies of the character follow the world directly
    data = mujoco.MjData(model)
    data.qpos[2] = 0.85
    mujoco.mj_forward(model, data)
    assert data.ncon and data.contact[0].friction[0] == pytest.approx(0.3)
