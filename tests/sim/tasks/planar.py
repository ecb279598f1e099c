"""Standing bodies placed by hand on the plane, and the same worlds turned and shifted."""

from dataclasses import replace

import numpy as np

from kinetok import rotation
from kinetok.sim.batch import BodyState


def standing(humanoid, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Start states: count bodies upright at x = 0, 1, 2 ... that head along x and do not move."""
    qpos = np.tile(humanoid.model.qpos0, (count, 1))
    qpos[:, 0], qpos[:, 2] = np.arange(count), 0.9
    return qpos, np.zeros((count, humanoid.nv))


def body_at(xy, *, angle=0.0, velocity=(0.0, 0.0), height=0.9) -> BodyState:
    """Rows with their root at xy (N, 2), heading and horizontal root velocity given for all or for each."""
    xy = np.array(xy, dtype=np.float32)
    n = len(xy)
    pos = np.random.default_rng(0).normal(size=(n, 15, 3)).astype(np.float32)
    pos[:, 0, :2], pos[:, 0, 2] = xy, height
    linear = np.zeros((n, 15, 3), np.float32)
    linear[:, 0, :2] = velocity
    return BodyState(
        pos=pos,
        mat=np.tile(np.eye(3, dtype=np.float32), (n, 15, 1, 1)),
        linear=linear,
        angular=np.zeros((n, 15, 3), np.float32),
        quat=rotation.about_z(np.broadcast_to(angle, n)).astype(np.float32),
    )


def turned(vectors: np.ndarray, angle: float) -> np.ndarray:
    """Vectors of the plane (..., 2) turned by an angle."""
    return vectors @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], dtype=vectors.dtype)


def moved(body: BodyState, angle: float, shift) -> BodyState:
    """The same bodies in a world turned about the vertical and then shifted by shift (2,)."""
    spin = rotation.to_matrix(rotation.about_z(np.array(angle))).astype(np.float32)
    offset = np.array([*shift, 0.0], dtype=np.float32)
    return replace(
        body,
        pos=body.pos @ spin.T + offset,
        mat=spin @ body.mat,
        linear=body.linear @ spin.T,
        angular=body.angular @ spin.T,
        quat=rotation.multiply(rotation.about_z(np.array(angle, dtype=np.float32)), body.quat),
    )
