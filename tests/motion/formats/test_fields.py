"""fields.py: what is missing, misshapen, not a number or no rotation is named with its place."""

import math
from pathlib import Path

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.formats import FormatError
from kinetok.motion.formats.fields import array, quaternions, rate

HERE = Path("motion.pkl")


def test_arrays_of_numbers_in_any_form():
    wanted = np.arange(6.0).reshape(3, 2)
    for value in (wanted, wanted.astype(">f4"), wanted.astype(int), wanted.tolist(), list(wanted)):
        found = array(HERE, {"x": value}, "x", (None, 2))
        assert found.dtype == np.float64
        np.testing.assert_array_equal(found, wanted)
    assert array(HERE, {"x": [1, 2]}, "x", (2,)).tolist() == [1, 2]


@pytest.mark.parametrize(
    ("value", "shape", "where", "reason"),
    [
        (np.zeros((3, 4)), (None, 3), "x", "has shape (3, 4); the format has (T, 3)"),
        (np.zeros((3, 4)), (4, 4), "x", "has shape (3, 4); the format has (4, 4)"),
        (np.zeros((1, 3)), (None, 3), "x", "1 frames; a motion needs at least two"),
        (np.array([[0, 1], [math.nan, 1]]), (None, 2), "x[1, 0]", "nan is not a finite number"),
        (np.array([[0, 1], [1, -math.inf]]), (None, 2), "x[1, 1]", "-inf is not a finite number"),
        (np.array([[0, 1], [1, 2e6]]), (None, 2), "x[1, 1]", "2000000.0 is beyond 1e+06"),
        ([[1, 2], [3]], (None, 2), "x", "rows of [1, 2] numbers; all rows need the same count"),
        ([[1, 2], [3, "a"]], (None, 2), "x", "holds something that is not a number"),
        ([[[1], 2], [3, 4]], (None, 2), "x", "holds something that is not a number"),
        ([[1.0, 10**400], [3, 4]], (None, 2), "x", "beyond 1e308"),
        ([], (None, 2), "x", "holds something that is not a number"),
        ([None, None], (None, 2), "x", "holds something that is not a number"),
        (np.array(["a", "b"]), (None,), "x", "is <U1, not numbers"),
        ("text", (None,), "x", "is str, not numbers"),
        (None, (None,), "x", "is NoneType, not numbers"),
    ],
)
def test_what_is_no_array(value, shape, where, reason):
    with pytest.raises(FormatError) as caught:
        array(HERE, {"x": value}, "x", shape)
    assert caught.value.where == where and reason in str(caught.value)


def test_a_missing_key_names_the_others():
    with pytest.raises(FormatError, match=r"motion\.pkl: x: is missing; the file holds: y, z"):
        array(HERE, {"y": 1, "z": 2}, "x", (None,))
    with pytest.raises(FormatError, match="fps: is missing; the file holds: nothing"):
        rate(HERE, {}, "fps")


def test_rows_repeated_without_end_are_not_expanded():
    row = [0.0] * 4000
    with pytest.raises(FormatError, match="all rows need the same count"):
        array(HERE, {"x": [row] * 10**5}, "x", (None, None))
    endless = np.lib.stride_tricks.as_strided(np.zeros(1), (10**9, 3), (0, 0))
    with pytest.raises(FormatError, match="3000000000 numbers"):
        array(HERE, {"x": endless}, "x", (None, 3))


@pytest.mark.parametrize("value", [30, 29.97, np.float32(30), np.array(60), np.array([50.0]), [50]])
def test_rates(value):
    assert rate(HERE, {"fps": value}, "fps") == pytest.approx(float(np.ravel(value)[0]))


@pytest.mark.parametrize("value", [0, -30, math.nan, math.inf, 1e6, [30, 30], "30", None, np.zeros(0)])
def test_what_is_no_rate(value):
    with pytest.raises(FormatError, match=r"fps: .*(is no frame rate|not numbers)"):
        rate(HERE, {"fps": value}, "fps")


def test_quaternions_are_ordered_made_unit_and_aligned():
    q = rotation.about_z(np.linspace(0, 1, 5))
    flipped = q * np.array([1, -1.01, 1, -0.99, 1])[:, None]
    np.testing.assert_allclose(quaternions(HERE, "q", flipped, "wxyz"), q, atol=1e-12)
    np.testing.assert_allclose(quaternions(HERE, "q", flipped[:, [1, 2, 3, 0]], "xyzw"), q, atol=1e-12)
    q[3] *= 0.5
    with pytest.raises(FormatError, match=r"q\[3\]: a quaternion of norm 0.5 is no rotation; are these its columns"):
        quaternions(HERE, "q", q, "wxyz")
