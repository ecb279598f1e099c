"""Rotations as arrays: unit quaternions (w, x, y, z), rotation vectors, headings, 6-D columns.

    q = multiply(from_rotvec([0, 0, 0.1]), q)
    angle = np.linalg.norm(to_rotvec(multiply(conjugate(a), b)), axis=-1)

Every function is pure, works on any leading shape and keeps the dtype of its input. Quaternions are wxyz,
as in MuJoCo; angles are radians; the world is z up. A quaternion and its negative are the same rotation.
This file knows nothing of characters, frames in time or tensors with gradients.
"""

import numpy as np

Array = np.ndarray


def normalize(q: Array) -> Array:
    """Unit quaternions (..., 4) along the last axis. A zero quaternion is an error, not an identity."""
    q = np.asarray(q)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not (norm > 1e-8).all():
        where = np.argwhere(~(norm[..., 0] > 1e-8))[0]
        raise ValueError(f"quaternion at index {where.tolist()} has norm {norm[tuple(where)][0]}; it is no rotation")
    return q / norm


def conjugate(q: Array) -> Array:
    """Inverse rotation of unit quaternions (..., 4)."""
    return q * np.array([1, -1, -1, -1], dtype=np.asarray(q).dtype)


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product (..., 4): first b, then a."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotate(q: Array, v: Array) -> Array:
    """Vectors v (..., 3) turned by unit quaternions q (..., 4)."""
    w, u = q[..., :1], q[..., 1:]
    t = 2 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def from_rotvec(v: Array) -> Array:
    """Exponential map: rotation vectors (..., 3) in radians to quaternions (..., 4)."""
    v = np.asarray(v)
    v = v.astype(np.result_type(v, np.float32), copy=False)
    half = np.linalg.norm(v, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), v * np.sinc(half / np.pi) / 2], axis=-1)


def to_rotvec(q: Array) -> Array:
    """Logarithm: unit quaternions (..., 4) to the shortest rotation vectors (..., 3), |v| <= pi.

    This is the length MuJoCo gives a ball joint's actuators (mju_quat2Vel with dt = 1).
    """
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    scale = np.where(sine < 1e-8, 2.0, angle / np.maximum(sine, 1e-12))
    return (q[..., 1:] * scale).astype(q.dtype)


def to_matrix(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def align(q: Array) -> Array:
    """Sequences (T, ..., 4) with signs chosen so that neighbours in time lie in one hemisphere."""
    dots = (q[1:] * q[:-1]).sum(-1, keepdims=True)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0).astype(q.dtype)
    return np.concatenate([q[:1], q[1:] * signs], axis=0)


def slerp(a: Array, b: Array, t: Array) -> Array:
    """Shortest-path interpolation from a to b (..., 4); t (...,) in [0, 1]."""
    b = np.where((a * b).sum(-1, keepdims=True) < 0, -b, b)
    return multiply(a, from_rotvec(to_rotvec(multiply(conjugate(a), b)) * np.asarray(t)[..., None]))


def heading(q: Array) -> Array:
    """Heading angles (...,) in radians: the twist of q about z (swing-twist decomposition).

    Unlike the direction of a body axis it stays defined when the body pitches by 90 degrees (crawling,
    lying); it is singular only upside down.
    """
    return 2 * np.arctan2(q[..., 3], q[..., 0])


def about_z(angle: Array) -> Array:
    """Quaternions (..., 4) turning by angle (...,) about the vertical."""
    half = np.asarray(angle) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def turn(v: Array, cos: Array, sin: Array) -> Array:
    """Vectors v (..., 3) turned about z by the angle whose cosine and sine are given (broadcast to v[..., 0])."""
    out = np.empty(np.broadcast_shapes(v.shape, (*np.shape(cos), 1)), dtype=v.dtype)
    x, y = v[..., 0], v[..., 1]
    out[..., 0] = cos * x - sin * y
    out[..., 1] = sin * x + cos * y
    out[..., 2] = v[..., 2]
    return out
