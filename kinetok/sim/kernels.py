"""Loops over rows that numba compiles: one pass over memory, where numpy takes one for every operation.

    @kernel
    def _heights(pos, out):
        for row in range(len(pos)):
            out[row] = pos[row, 0, 2]

A kernel takes arrays and numbers, writes into what it is given, and keeps every row to itself, so that rows may be
divided among threads without changing a bit. It is compiled when it is first called, some seconds, and kept beside its
file or in the user's cache for later processes. A whole number times a float32 is a float64 to it: numbers that meet
arrays are written as those are.
"""

import numpy as np
from numba import njit

kernel = njit(nogil=True, cache=True, error_model="numpy")


@kernel
def turn_back(w, z):
    """Cosine and sine of minus the heading of a quaternion (w, ., ., z): rotation.heading without its angle."""
    square = w * w + z * z
    if square == 0:  # upside down, where there is no heading
        return np.cos(square), square
    return (w * w - z * z) / square, -(w * z + w * z) / square


@kernel
def put_turned(x, y, z, cos, sin, out, row, column):
    """Write a vector turned about the vertical to out[row, column:column + 3]; returns the next column."""
    out[row, column] = cos * x - sin * y
    out[row, column + 1] = sin * x + cos * y
    out[row, column + 2] = z
    return column + 3
