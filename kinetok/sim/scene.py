"""The world around a character: floor, light, camera and solver options, composed with MjSpec.

    model = build_scene(Character.load("humanoid"), SceneConfig())

Geom 0 is the floor (per-row friction is set there). The solver is PGS with 10 iterations and a pyramidal
cone: on this model it steps 1.4 times as fast as Newton with 5 at the same contacts.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from kinetok.motion.character import Character


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """control_hz: policy steps per second; substeps: physics steps per policy step; iterations: of PGS."""

    control_hz: int = 30
    substeps: int = 4
    iterations: int = 10
    friction: float = 1.0


def build_scene(character: Character, config: SceneConfig) -> mujoco.MjModel:
    """Compile the character on a floor."""
    return scene_spec(character, config).compile()


def scene_spec(character: Character, config: SceneConfig) -> mujoco.MjSpec:
    """The character on a floor, before it is compiled: the place to add to it."""
    spec = mujoco.MjSpec.from_string(character.xml)
    spec.modelname = f"kinetok-{character.name}"
    spec.memory = 1 << 20  # bytes for contacts, of every row; a humanoid lying down takes a tenth (the default: 15 MB)
    option = spec.option
    option.timestep = 1 / (config.control_hz * config.substeps)
    option.solver = mujoco.mjtSolver.mjSOL_PGS
    option.iterations = config.iterations
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 720
    spec.visual.quality.shadowsize = 1024
    spec.visual.quality.offsamples = 0
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    _floor(spec, config.friction)
    spec.worldbody.add_light(pos=[0, 0, 6], dir=[0.2, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    return spec


def _floor(spec: mujoco.MjSpec, friction: float) -> None:
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        width=256,
        height=256,
        rgb1=[0.82, 0.84, 0.87],
        rgb2=[0.70, 0.73, 0.78],
    )
    material = spec.add_material(name="floor", texrepeat=[1, 1], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        material="floor",
        rgba=[1, 1, 1, 1],  # not the colour of the character's default class
        friction=np.array([friction, 0.05, 0.05]),
        contype=1,
        conaffinity=1,
        priority=1,  # else a contact takes the larger friction of its two geoms: a slippery floor would not slip
    )
