"""Where the bodies of a clip are and how they move, by batched simulation: T frames are T simulations.

    motion = kinematics(character, qpos, fps)      # qpos (T, nq)
    motion.xpos, motion.cvel ...

Velocities are central differences of the poses in the tangent space (mj_differentiatePos), one-sided at the
ends. No contact, no time stepping, no learning.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch

from kinetok.motion.character import Character


@dataclass(frozen=True, kw_only=True)
class Motion:
    """qpos (T, nq), qvel (T, nv); xpos (T, B, 3) m, xquat (T, B, 4), linear and angular (T, B, 3) m/s, rad/s, world;
    com (T, 3), the whole body's centre of mass."""

    qpos: np.ndarray
    qvel: np.ndarray
    xpos: np.ndarray
    xquat: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    com: np.ndarray


def velocities(body: Character, qpos: np.ndarray, fps: float) -> np.ndarray:
    """Generalised velocities (T, nv) of poses (T, nq)."""
    after = np.minimum(np.arange(len(qpos)) + 1, len(qpos) - 1)
    before = np.maximum(np.arange(len(qpos)) - 1, 0)
    qvel = np.empty((len(qpos), body.nv))
    for t, (a, b) in enumerate(zip(before, after, strict=True)):
        mujoco.mj_differentiatePos(body.model, qvel[t], (b - a) / fps, qpos[a], qpos[b])
    return qvel


def kinematics(body: Character, qpos: np.ndarray, fps: float) -> Motion:
    """Forward kinematics and body velocities of poses (T, nq) at fps frames per second."""
    qvel = velocities(body, qpos, fps)
    batch = Batch(body.model, len(qpos))
    names = ("xpos", "xquat", "cvel", "subtree_com")
    out = {name: batch.bind(name) for name in names}
    batch.bind("qpos")[:] = qpos
    batch.bind("qvel")[:] = qvel
    batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
    xpos, cvel = out["xpos"][:, 1:].copy(), out["cvel"][:, 1:]
    arm = xpos - out["subtree_com"][:, 1:2]
    return Motion(
        qpos=np.array(qpos),
        qvel=qvel,
        xpos=xpos,
        xquat=out["xquat"][:, 1:].copy(),
        linear=cvel[..., 3:] + np.cross(cvel[..., :3], arm),
        angular=cvel[..., :3].copy(),
        com=out["subtree_com"][:, 1].copy(),
    )


def joint_anchors(body: Character) -> np.ndarray:
    """Where each body's first joint is (B, 3), in the body's frame; its origin where it has none."""
    model, anchors = body.model, np.zeros((body.model.nbody - 1, 3))
    first = model.body_jntadr[1:]
    anchors[first >= 0] = model.jnt_pos[first[first >= 0]]
    return anchors


def lowest_point(body: Character, qpos: np.ndarray) -> np.ndarray:
    """Height (T,) of the lowest point of any geom for poses (T, nq), metres."""
    model, batch = body.model, Batch(body.model, len(qpos))
    geom_xpos, geom_xmat = batch.bind("geom_xpos"), batch.bind("geom_xmat")
    batch.bind("qpos")[:] = qpos
    batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS)
    z = geom_xmat.reshape(len(qpos), model.ngeom, 3, 3)[:, :, 2]
    reach = np.empty((len(qpos), model.ngeom))
    for g in range(model.ngeom):
        size, kind = model.geom_size[g], model.geom_type[g]
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            reach[:, g] = size[0]
        elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            reach[:, g] = size[0] + size[1] * np.abs(z[:, g, 2])
        else:
            box = size if kind == mujoco.mjtGeom.mjGEOM_BOX else model.geom_aabb[g, 3:]
            reach[:, g] = np.abs(z[:, g]) @ box
    return (geom_xpos[:, :, 2] - reach).min(1)
