"""Observation features as pure functions of body states. All vectors are in the heading frame of the
simulated root (yaw removed), so that features do not change when the world is shifted or turned.

    state_features(body)                                           (N, 1 + 14 * 3 + 15 * 12) for the humanoid
    window_features(body, pose, root, facing, ahead)               (N, F * (14 * 3 + 15 * 6 + 6))
    error_features(body, reference)                                (N, 15 * 12)

GPC app. B.1: root height, joint positions relative to the root, 6-D orientations, linear and angular
velocities. Departure: the future frames carry no velocities; at this dilation they are differences of poses
the window already holds, and they would double the encoder's cost on a CPU.

Features are written to `out` (N, O), an observation, from column `start` on, where it is given.
"""

import numpy as np

from kinetok.sim.batch import BodyState
from kinetok.sim.kernels import kernel, put_turned, turn_back


def state_size(bodies: int) -> int:
    return 1 + (bodies - 1) * 3 + bodies * 12


def pose_size(bodies: int) -> int:
    return (bodies - 1) * 3 + bodies * 6


def window_size(bodies: int, frames: int) -> int:
    return frames * (pose_size(bodies) + 6)


def error_size(bodies: int) -> int:
    return bodies * 12


def state_features(body: BodyState, out: np.ndarray | None = None, start: int = 0) -> np.ndarray:
    """Proprioception (N, state_size): height, positions, 6-D orientations, linear and angular velocities."""
    out = _room(body, state_size(body.pos.shape[1])) if out is None else out
    _state(body.pos, body.mat, body.linear, body.angular, body.quat, out, start)
    return out


def pose_features(pos: np.ndarray, mat: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """What a reference frame shows of itself (F, (B - 1) * 3 + B * 6), in its own heading frame: computed once."""
    out = np.empty((len(pos), pose_size(pos.shape[1])), dtype=np.float32)
    _pose(pos, mat, quat, out, 0)
    return out


def window_features(
    body: BodyState,
    pose: np.ndarray,
    root: np.ndarray,
    facing: np.ndarray,
    ahead: np.ndarray,
    beyond: np.ndarray | None = None,
    out: np.ndarray | None = None,
    start: int = 0,
) -> np.ndarray:
    """Future frames relative to the body (N, window_size).

    Of a table of K reference frames: pose (K, P) from pose_features; root (K, 3) positions; facing (K, 2), cosine and
    sine of the heading; and ahead (N, F), the frames of it that each row sees. Each adds its root's offset in the
    body's heading frame, its height, and cosine and sine of its heading relative to the body's. beyond (N, 2): metres
    of the floor by which the frames are shown nearer.
    """
    out = _room(body, window_size(body.pos.shape[1], ahead.shape[1])) if out is None else out
    _window(body.pos, body.quat, pose, root, facing, ahead, _or_none(beyond, body), out, start)
    return out


def error_features(
    body: BodyState,
    reference: BodyState,
    due: np.ndarray | None = None,
    beyond: np.ndarray | None = None,
    out: np.ndarray | None = None,
    start: int = 0,
) -> np.ndarray:
    """Tracking error now (N, error_size): position, rotation (sine of the angle times its axis) and velocities.

    due (N,): the rows of `reference` in which the body's should be; its own, where not given. beyond (N, 2): metres of
    the floor by which the reference is shown nearer.
    """
    out = _room(body, error_size(body.pos.shape[1])) if out is None else out
    due = np.arange(len(body.pos)) if due is None else due
    _error(*body.moving, body.quat, *reference.moving, due, _or_none(beyond, body), out, start)
    return out


def _room(body: BodyState, columns: int) -> np.ndarray:
    return np.empty((len(body.pos), columns), dtype=np.float32)


def _or_none(beyond: np.ndarray | None, body: BodyState) -> np.ndarray:
    return np.zeros((len(body.pos), 2), dtype=np.float32) if beyond is None else beyond


@kernel
def _put_pose(pos, mat, row, cos, sin, out, column):
    """Positions relative to the root and the first two columns of the rotations (6-D form) of one row."""
    for b in range(1, pos.shape[1]):
        x, y = pos[row, b, 0] - pos[row, 0, 0], pos[row, b, 1] - pos[row, 0, 1]
        column = put_turned(x, y, pos[row, b, 2] - pos[row, 0, 2], cos, sin, out, row, column)
    for b in range(pos.shape[1]):
        for axis in range(2):
            x, y, z = mat[row, b, 0, axis], mat[row, b, 1, axis], mat[row, b, 2, axis]
            column = put_turned(x, y, z, cos, sin, out, row, column)
    return column


@kernel
def _pose(pos, mat, quat, out, start):
    for row in range(len(pos)):
        cos, sin = turn_back(quat[row, 0], quat[row, 3])
        _put_pose(pos, mat, row, cos, sin, out, start)


@kernel
def _state(pos, mat, linear, angular, quat, out, start):
    for row in range(len(pos)):
        cos, sin = turn_back(quat[row, 0], quat[row, 3])
        out[row, start] = pos[row, 0, 2]
        column = _put_pose(pos, mat, row, cos, sin, out, start + 1)
        for velocity in (linear, angular):
            for b in range(pos.shape[1]):
                x, y, z = velocity[row, b, 0], velocity[row, b, 1], velocity[row, b, 2]
                column = put_turned(x, y, z, cos, sin, out, row, column)


@kernel
def _window(pos, quat, pose, root, facing, ahead, beyond, out, start):
    width = pose.shape[1]
    for row in range(len(pos)):
        cos, sin = turn_back(quat[row, 0], quat[row, 3])
        column = start
        for f in range(ahead.shape[1]):
            frame = ahead[row, f]
            for k in range(width):
                out[row, column + k] = pose[frame, k]
            x, y = root[frame, 0] - beyond[row, 0] - pos[row, 0, 0], root[frame, 1] - beyond[row, 1] - pos[row, 0, 1]
            column = put_turned(x, y, root[frame, 2] - pos[row, 0, 2], cos, sin, out, row, column + width)
            out[row, column] = root[frame, 2]
            out[row, column + 1] = cos * facing[frame, 0] - sin * facing[frame, 1]
            out[row, column + 2] = sin * facing[frame, 0] + cos * facing[frame, 1]
            column += 3


@kernel
def _error(pos, mat, linear, angular, quat, pos_due, mat_due, linear_due, angular_due, due, beyond, out, start):
    # numbers of the arrays' own type, see kernels.py
    none, half, tenth, one = np.float32(0), np.float32(0.5), np.float32(0.1), np.float32(1)
    for row in range(len(pos)):
        cos, sin = turn_back(quat[row, 0], quat[row, 3])
        x, y, at = beyond[row, 0], beyond[row, 1], due[row]
        column = _put_differences(pos[row], pos_due[at], x, y, one, cos, sin, out, row, start)
        for b in range(pos.shape[1]):
            now, then = mat[row, b], mat_due[at, b]
            x, y, z = _skew(now, then, 1, 2), _skew(now, then, 2, 0), _skew(now, then, 0, 1)
            column = put_turned(half * x, half * y, half * z, cos, sin, out, row, column)
        column = _put_differences(linear[row], linear_due[at], none, none, tenth, cos, sin, out, row, column)
        _put_differences(angular[row], angular_due[at], none, none, tenth, cos, sin, out, row, column)


@kernel
def _put_differences(now, due, less_x, less_y, scale, cos, sin, out, row, column):
    """What vectors (B, 3) are short of those due, which are shown nearer by so many metres."""
    for b in range(len(now)):
        x, y, z = due[b, 0] - less_x - now[b, 0], due[b, 1] - less_y - now[b, 1], due[b, 2] - now[b, 2]
        column = put_turned(scale * x, scale * y, scale * z, cos, sin, out, row, column)
    return column


@kernel
def _skew(now, due, i, j):
    """Twice the (i, j) entry of the skew part of R R_due^T, row times row."""
    total = now[i, 0] * due[j, 0] - now[j, 0] * due[i, 0]
    for k in range(1, 3):
        total += now[i, k] * due[j, k] - now[j, k] * due[i, k]
    return total
