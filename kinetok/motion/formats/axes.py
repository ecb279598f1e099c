"""Euler angles of any order, and the change between y-up and z-up worlds, for the readers of skeleton files.

    q = from_euler(np.deg2rad(values), "ZXY")            # turn about z, then about the new x, then about the new y
    position, q = z_up(position), z_up(q)

Pure functions on any leading shape; quaternions are wxyz, angles radians.
"""

import numpy as np

from kinetok import rotation

ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


def from_euler(angles: np.ndarray, order: str) -> np.ndarray:
    """Quaternions (..., 4) of intrinsic rotations (..., k) in radians about the k axes of `order`, first to last."""
    q = np.zeros((*angles.shape[:-1], 4))
    q[..., 0] = 1
    for index, axis in enumerate(order):
        turn = np.zeros_like(q)
        turn[..., 0], turn[..., 1 + "XYZ".index(axis)] = np.cos(angles[..., index] / 2), np.sin(angles[..., index] / 2)
        q = rotation.multiply(q, turn) if index else turn
    return q


def to_euler(q: np.ndarray, order: str) -> np.ndarray:
    """Angles (..., 3) in radians of intrinsic rotations about the axes of `order`; from_euler undoes it.

    With R = A_i(a) A_j(b) A_k(c) and s the sign of the permutation ijk, R_ik = s sin b. Where cos b vanishes, only
    the sum or difference of a and c is determined; c is then 0.
    """
    i, j, k = ("XYZ".index(axis) for axis in order)
    sign = 1 if order in ("XYZ", "YZX", "ZXY") else -1
    m = rotation.to_matrix(q)
    level = np.hypot(m[..., i, i], m[..., i, j])
    first = np.arctan2(-sign * m[..., j, k], m[..., k, k])
    locked = level < 1e-9
    first = np.where(locked, np.arctan2(sign * m[..., k, j], m[..., j, j]), first)
    last = np.where(locked, 0, np.arctan2(-sign * m[..., i, j], m[..., i, i]))
    return np.stack([first, np.arctan2(sign * m[..., i, k], level), last], axis=-1)


def z_up(v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) or quaternions (..., 4) of a y-up world in the z-up one: (x, y, z) -> (x, -z, y)."""
    return np.stack([*np.moveaxis(v[..., :-3], -1, 0), v[..., -3], -v[..., -1], v[..., -2]], axis=-1)


def y_up(v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) or quaternions (..., 4) of the z-up world in a y-up one: (x, y, z) -> (x, z, -y)."""
    return np.stack([*np.moveaxis(v[..., :-3], -1, 0), v[..., -3], v[..., -1], -v[..., -2]], axis=-1)
