"""observe.py: what is seen does not change when the world is shifted and turned; errors vanish on the reference."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kinetok import rotation
from kinetok.sim import observe
from kinetok.sim.batch import BodyState
from kinetok.sim.reward import tracking_errors

N, B, F = 6, 4, 3


def body(seed: int) -> BodyState:
    rng = np.random.default_rng(seed)
    mat = Rotation.random(N * B, random_state=seed)
    quat = mat.as_quat(scalar_first=True).reshape(N, B, 4)[:, 0]
    pos, linear, angular = rng.normal(size=(3, N, B, 3))
    return state(pos, mat.as_matrix().reshape(N, B, 3, 3), linear, angular, quat)


def state(pos, mat, linear, angular, quat) -> BodyState:
    f = np.float32
    return BodyState(pos=pos.astype(f), mat=mat.astype(f), linear=linear.astype(f), angular=angular.astype(f),
                     quat=quat.astype(f))  # fmt: skip


def moved(s: BodyState, yaw: np.ndarray, shift: np.ndarray) -> BodyState:
    """The same world turned by yaw (N,) about z and shifted horizontally by shift (N, 2)."""
    turn = rotation.to_matrix(rotation.about_z(yaw))
    pos = np.einsum("nij,nbj->nbi", turn, s.pos)
    pos[..., :2] += shift[:, None]
    vectors = [np.einsum("nij,nbj->nbi", turn, v) for v in (s.linear, s.angular)]
    return state(pos, turn[:, None] @ s.mat, *vectors, rotation.multiply(rotation.about_z(yaw), s.quat))


@pytest.fixture
def motion():
    rng = np.random.default_rng(9)
    return rng.uniform(-3, 3, N), rng.uniform(-5, 5, (N, 2))


def window(s: BodyState, reference: BodyState) -> np.ndarray:
    """Each reference row seen F times as the future of its body."""
    pose = observe.pose_features(reference.pos, reference.mat, reference.quat)
    heading = rotation.heading(reference.quat)
    ahead = np.repeat(np.arange(N)[:, None], F, axis=1)
    facing = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return observe.window_features(s, pose, reference.pos[:, 0], facing, ahead)


def test_sizes():
    assert observe.state_features(body(0)).shape == (N, observe.state_size(B)) == (N, 1 + 9 + 48)
    assert window(body(0), body(1)).shape == (N, observe.window_size(B, F)) == (N, 3 * (9 + 24 + 6))
    assert observe.error_features(body(0), body(1)).shape == (N, observe.error_size(B)) == (N, 48)
    assert observe.state_features(body(0)).dtype == np.float32


def test_invariant_under_shift_and_yaw(motion):
    a, b = body(0), body(1)
    a2, b2 = moved(a, *motion), moved(b, *motion)
    np.testing.assert_allclose(observe.state_features(a2), observe.state_features(a), atol=2e-5)
    np.testing.assert_allclose(window(a2, b2), window(a, b), atol=2e-5)
    np.testing.assert_allclose(observe.error_features(a2, b2), observe.error_features(a, b), atol=2e-5)


def test_not_invariant_when_only_the_body_moves(motion):
    a, b = body(0), body(1)
    assert np.abs(window(moved(a, *motion), b) - window(a, b)).max() > 0.1
    assert np.abs(observe.error_features(moved(a, *motion), b) - observe.error_features(a, b)).max() > 0.1


def test_state_by_hand():
    # heading 90 degrees: the world's +y is ahead, its -x is to the left
    quat = rotation.about_z(np.array([np.pi / 2]))
    pos = np.array([[[5.0, 6.0, 0.9], [5.0, 7.0, 1.9]]])
    mat = np.tile(np.eye(3), (1, 2, 1, 1))
    linear = np.array([[[-1.0, 0.0, 0.0], [0.0, 0.0, 3.0]]])
    angular = np.array([[[0.0, 2.0, 0.0], [0.0, 0.0, 4.0]]])
    columns = [0, -1, 0, 1, 0, 0]  # world x and y axes, seen from that heading
    expected = [0.9, 1, 0, 1, *columns, *columns, 0, 1, 0, 0, 0, 3, 2, 0, 0, 0, 0, 4]
    got = observe.state_features(state(pos, mat, linear, angular, quat))
    np.testing.assert_allclose(got, [expected], atol=1e-6)


def test_errors_vanish_on_the_reference():
    np.testing.assert_allclose(observe.error_features(body(0), body(0)), 0, atol=1e-6)


def test_rotation_error_is_sine_times_axis():
    identity = np.tile(np.eye(3), (N, B, 1, 1))
    vector = np.array([0.2, -0.1, 0.3])
    turned = np.tile(Rotation.from_rotvec(vector).as_matrix(), (N, B, 1, 1))
    zero, quat = np.zeros((N, B, 3)), np.tile([1.0, 0, 0, 0], (N, 1))
    got = observe.error_features(state(zero, identity, zero, zero, quat), state(zero, turned, zero, zero, quat))
    angle = np.linalg.norm(vector)
    np.testing.assert_allclose(got[:, B * 3 : B * 6].reshape(N, B, 3)[0, 0], np.sin(angle) * vector / angle, atol=1e-6)


def test_written_into_a_slice_of_an_observation():
    a, b = body(0), body(1)
    obs = np.full((N, 300), 7.0, dtype=np.float32)
    observe.state_features(a, obs, 3)
    observe.error_features(a, b, out=obs, start=100)
    np.testing.assert_array_equal(obs[:, 3:61], observe.state_features(a)[:, :58])
    np.testing.assert_array_equal(obs[:, 100:148], observe.error_features(a, b))
    assert (obs[:, :3] == 7).all() and (obs[:, 61:100] == 7).all() and (obs[:, 148:] == 7).all()


def test_what_is_due_may_be_any_rows_of_a_table():
    a, table, due = body(0), body(1), np.arange(N)[::-1].copy()
    np.testing.assert_array_equal(observe.error_features(a, table, due), observe.error_features(a, table.rows(due)))
    for name, errors in tracking_errors(a, table, due).items():
        np.testing.assert_array_equal(errors, tracking_errors(a, table.rows(due))[name])
