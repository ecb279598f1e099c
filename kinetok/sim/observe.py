"""Observation features as pure functions of body states. All vectors are in the heading frame of the
simulated root (yaw removed), so that features do not change when the world is shifted or turned.

    state_features(body)                                   (N, 1 + 14 * 3 + 15 * 12) for the humanoid
    window_features(body, reference frames)                (N, F * (14 * 3 + 15 * 6 + 6))
    error_features(body, reference)                        (N, 15 * 12)

GPC app. B.1: root height, joint positions relative to the root, 6-D orientations, linear and angular
velocities. Departure: the future frames carry no velocities; at this dilation they are differences of poses
the window already holds, and they would double the encoder's cost on a CPU.
"""

import numpy as np
from einops import rearrange

from kinetok import rotation
from kinetok.sim.batch import BodyState


def state_size(bodies: int) -> int:
    return 1 + (bodies - 1) * 3 + bodies * 12


def window_size(bodies: int, frames: int) -> int:
    return frames * ((bodies - 1) * 3 + bodies * 6 + 6)


def error_size(bodies: int) -> int:
    return bodies * 12


def _seen_(out: np.ndarray, parts: list[np.ndarray], quat: np.ndarray) -> None:
    """World vectors, parts of (N, k, 3), seen from the heading of root quaternions (N, 4), written to out (N, 3 K)."""
    angle = rotation.heading(quat)
    cos, sin = np.cos(angle)[:, None], -np.sin(angle)[:, None]
    vectors, start = out.reshape(len(out), -1, 3), 0
    for part in parts:
        stop = start + part.shape[1]
        rotation.turn(part, cos, sin, out=vectors[:, start:stop])
        start = stop


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nbk,nbk->nb", a, b)


def _columns(mat: np.ndarray) -> np.ndarray:
    """First two columns of rotation matrices (N, B, 3, 3) as vectors (N, 2 B, 3): the 6-D form."""
    return rearrange(mat[..., :2], "n b x c -> n (b c) x")


def state_features(body: BodyState, out: np.ndarray | None = None) -> np.ndarray:
    """Proprioception (N, state_size): height, positions, 6-D orientations, linear and angular velocities.

    Like the other features here, it is written to `out` where that is given: a slice of an observation.
    """
    rows, bodies = body.pos.shape[:2]
    out = np.empty((rows, state_size(bodies)), dtype=np.float32) if out is None else out
    out[:, 0] = body.pos[:, 0, 2]
    parts = [body.pos[:, 1:] - body.pos[:, :1], _columns(body.mat), body.linear, body.angular]
    _seen_(out[:, 1:], parts, body.quat)
    return out


def pose_features(pos: np.ndarray, mat: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """What a reference frame shows of itself (F, (B - 1) * 3 + B * 6), in its own heading frame: computed once."""
    frames, bodies = pos.shape[:2]
    out = np.empty((frames, (bodies - 1) * 3 + bodies * 6), dtype=np.float32)
    _seen_(out, [pos[:, 1:] - pos[:, :1], _columns(mat)], quat)
    return out


def window_features(
    body: BodyState, pose: np.ndarray, root: np.ndarray, heading: np.ndarray, out: np.ndarray | None = None
) -> np.ndarray:
    """Future frames relative to the body (N, window_size).

    pose (N, F, P) from pose_features; root (N, F, 3) reference root positions; heading (N, F) radians.
    Each frame adds its root offset in the body's heading frame, its height and its relative heading.
    """
    rows, frames, width = pose.shape
    out = np.empty((rows, frames * (width + 6)), dtype=np.float32) if out is None else out
    window = out.reshape(rows, frames, width + 6)
    angle = rotation.heading(body.quat)
    window[..., :width] = pose
    offset = window[..., width : width + 3]
    rotation.turn(root - body.pos[:, :1], np.cos(angle)[:, None], -np.sin(angle)[:, None], out=offset)
    relative = heading - angle[:, None]
    window[..., width + 3] = root[..., 2]
    window[..., width + 4] = np.cos(relative)
    window[..., width + 5] = np.sin(relative)
    return out


def error_features(body: BodyState, reference: BodyState, out: np.ndarray | None = None) -> np.ndarray:
    """Tracking error now (N, error_size): position, rotation (sine of the angle times its axis) and velocities."""
    rows, bodies = body.pos.shape[:2]
    out = np.empty((rows, error_size(bodies)), dtype=np.float32) if out is None else out
    twist = np.empty_like(body.pos)  # skew part of R R_ref^T, row times row
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        twist[..., axis] = _dot(body.mat[..., i, :], reference.mat[..., j, :])
        twist[..., axis] -= _dot(body.mat[..., j, :], reference.mat[..., i, :])
    parts = [
        reference.pos - body.pos,
        twist / 2,
        (reference.linear - body.linear) * 0.1,
        (reference.angular - body.angular) * 0.1,
    ]
    _seen_(out, parts, body.quat)
    return out
