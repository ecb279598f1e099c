"""rotation.py against scipy, and the laws its functions obey."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from kinetok import rotation

RNG = np.random.default_rng(0)
A, B = (Rotation.random(200, random_state=seed) for seed in (0, 1))


def wxyz(r: Rotation) -> np.ndarray:
    return r.as_quat(scalar_first=True)


def assert_same_rotation(a, b, atol=1e-12):
    np.testing.assert_allclose(a * np.sign((a * b).sum(-1, keepdims=True)), b, atol=atol)


def test_multiply_and_conjugate():
    assert_same_rotation(rotation.multiply(wxyz(A), wxyz(B)), wxyz(A * B))
    assert_same_rotation(rotation.conjugate(wxyz(A)), wxyz(A.inv()))


def test_rotate_and_matrix():
    v = RNG.normal(size=(200, 3))
    np.testing.assert_allclose(rotation.rotate(wxyz(A), v), A.apply(v), atol=1e-12)
    np.testing.assert_allclose(rotation.to_matrix(wxyz(A)), A.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-6, 1e-3, 1.0, 3.0, np.pi - 1e-6, np.pi - 1e-9])
def test_rotvec_both_ways(angle):
    axes = RNG.normal(size=(50, 3))
    vectors = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    quats = rotation.from_rotvec(vectors)
    assert_same_rotation(quats, wxyz(Rotation.from_rotvec(vectors)))
    np.testing.assert_allclose(rotation.to_rotvec(quats), vectors, atol=1e-12 + 1e-9 * angle)
    np.testing.assert_allclose(rotation.to_rotvec(-quats), vectors, atol=1e-12 + 1e-9 * angle)


def test_rotvec_takes_the_short_way_round():
    long = rotation.from_rotvec(np.array([0.0, 0.0, np.pi + 0.1]))
    np.testing.assert_allclose(rotation.to_rotvec(long), [0, 0, 0.1 - np.pi], atol=1e-12)


def test_lists_and_single_precision():
    np.testing.assert_allclose(rotation.from_rotvec([0, 0, np.pi]), [0, 0, 0, 1], atol=1e-12)
    q = wxyz(A).astype(np.float32)
    for out in (rotation.to_rotvec(q), rotation.multiply(q, q), rotation.from_rotvec(q[:, 1:]), rotation.to_matrix(q)):
        assert out.dtype == np.float32
    assert_same_rotation(rotation.from_rotvec(rotation.to_rotvec(q)), q, atol=1e-6)


def test_slerp():
    for t in (0.0, 0.3, 1.0):
        expected = [Slerp([0, 1], Rotation.concatenate([a, b]))(t) for a, b in zip(A[:20], B[:20], strict=True)]
        got = rotation.slerp(wxyz(A[:20]), -wxyz(B[:20]), np.full(20, t))
        assert_same_rotation(got, wxyz(Rotation.concatenate(expected)), atol=1e-9)


def test_align_puts_neighbours_in_one_hemisphere():
    path = rotation.from_rotvec(np.linspace(0, 6, 40)[:, None] * [0.0, 0.6, 0.8])
    flipped = path * RNG.choice([-1.0, 1.0], size=(40, 1))
    aligned = rotation.align(flipped)
    np.testing.assert_allclose(aligned, path * np.sign(flipped[0] @ path[0]), atol=1e-12)


def test_heading_of_yaw_times_tilt_is_the_yaw():
    yaw = RNG.uniform(-3, 3, 100)
    tilt = np.zeros((100, 3))
    tilt[:, :2] = RNG.uniform(-1.5, 1.5, (100, 2))
    got = rotation.heading(rotation.multiply(rotation.about_z(yaw), rotation.from_rotvec(tilt)))
    np.testing.assert_allclose(np.exp(1j * got), np.exp(1j * yaw), atol=1e-12)


def test_turn_is_rotation_about_z():
    angle, v = RNG.uniform(-4, 4, 30), RNG.normal(size=(30, 3))
    expected = rotation.rotate(rotation.about_z(angle), v)
    np.testing.assert_allclose(rotation.turn(v, np.cos(angle), np.sin(angle)), expected, atol=1e-12)


def test_normalize():
    np.testing.assert_allclose(np.linalg.norm(rotation.normalize(3.7 * wxyz(A)), axis=1), 1)
    with pytest.raises(ValueError, match=r"quaternion at index \[1\] has norm 0.0; it is no rotation"):
        rotation.normalize(np.array([[1.0, 0, 0, 0], [0, 0, 0, 0]]))
