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
from kinetok.sim.batch import BodyState, cross


def state_size(bodies: int) -> int:
    return 1 + (bodies - 1) * 3 + bodies * 12


def window_size(bodies: int, frames: int) -> int:
    return frames * ((bodies - 1) * 3 + bodies * 6 + 6)


def error_size(bodies: int) -> int:
    return bodies * 12


def _unyaw(vectors: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """World vectors (N, K, 3) seen from the heading of root quaternions (N, 4)."""
    angle = rotation.heading(quat)
    return rotation.turn(vectors, np.cos(angle)[:, None], -np.sin(angle)[:, None])


def _columns(mat: np.ndarray) -> np.ndarray:
    """First two columns of rotation matrices (N, B, 3, 3) as vectors (N, 2 B, 3): the 6-D form."""
    return rearrange(mat[..., :2], "n b x c -> n (b c) x")


def state_features(body: BodyState) -> np.ndarray:
    """Proprioception (N, state_size): height, positions, 6-D orientations, linear and angular velocities."""
    vectors = np.concatenate([body.pos[:, 1:] - body.pos[:, :1], _columns(body.mat), body.linear, body.angular], axis=1)
    return np.concatenate([body.pos[:, 0, 2:], _unyaw(vectors, body.quat).reshape(len(vectors), -1)], axis=1)


def pose_features(pos: np.ndarray, mat: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """What a reference frame shows of itself (F, (B - 1) * 3 + B * 6), in its own heading frame: computed once."""
    vectors = np.concatenate([pos[:, 1:] - pos[:, :1], _columns(mat)], axis=1)
    return _unyaw(vectors, quat).reshape(len(vectors), -1)


def window_features(body: BodyState, pose: np.ndarray, root: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Future frames relative to the body (N, window_size).

    pose (N, F, P) from pose_features; root (N, F, 3) reference root positions; heading (N, F) radians.
    Each frame adds its root offset in the body's heading frame, its height and its relative heading.
    """
    angle = rotation.heading(body.quat)
    offset = rotation.turn(root - body.pos[:, :1], np.cos(angle)[:, None], -np.sin(angle)[:, None])
    relative = heading - angle[:, None]
    extra = np.stack([root[..., 2], np.cos(relative), np.sin(relative)], axis=-1)
    return np.concatenate([pose, offset, extra], axis=-1).reshape(len(pose), -1)


def error_features(body: BodyState, reference: BodyState) -> np.ndarray:
    """Tracking error now (N, error_size): position, rotation (sine of the angle times its axis) and velocities."""
    twist = cross(
        np.ascontiguousarray(np.swapaxes(body.mat, -1, -2)), np.ascontiguousarray(np.swapaxes(reference.mat, -1, -2))
    ).sum(-2)
    vectors = np.concatenate(
        [
            reference.pos - body.pos,
            twist / 2,
            (reference.linear - body.linear) * 0.1,
            (reference.angular - body.angular) * 0.1,
        ],
        axis=1,
    )
    return _unyaw(vectors, body.quat).reshape(len(vectors), -1)
