"""Put a motion on the floor, frame by frame: recorded figures sink and float by centimetres within one clip.

    qpos[:, 2] -= floor_height(character, qpos, fps)

A simulated body cannot hover: a reference that stands 6 cm above the floor is followed on tiptoe or not at all. A
frame stands when its centre of mass does not fall freely and its lowest point is slow and near the floor; there the
lowest point is the floor. Through flight the floor runs straight from the last standing frame to the next one, so
jumps keep their height.
"""

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter1d

from kinetok.motion.character import Character
from kinetok.motion.kinematics import kinematics, lowest_point

FALL = -5.0  # m/s^2 of the centre of mass below which nothing holds it
NEAR, SLOW = 0.2, 0.4  # m over the clip's own floor, m/s up or down: more is a step or a leap
EDGE, SMOOTH = 0.05, 0.05  # s that a flight is longer than its free fall; of the smoothing


def floor_height(body: Character, qpos: np.ndarray, fps: float, *, loop: bool = False) -> np.ndarray:
    """Height (T,) of the floor under poses (T, nq) at fps frames per second, metres; a loop's is a loop."""
    low, height = lowest_point(body, qpos), kinematics(body, qpos, fps).com[:, 2]
    level = float(np.percentile(low, 5))
    low = low - level
    if loop:  # the cycle before and the one after
        low, height = (np.concatenate([x[:-1], x[:-1], x]) for x in (low, height))
    falls = np.gradient(np.gradient(gaussian_filter1d(height, SMOOTH * fps), 1 / fps), 1 / fps) < FALL
    flies = np.asarray(binary_dilation(falls, iterations=max(round(EDGE * fps), 1)), dtype=bool)
    slow = np.abs(np.gradient(low, 1 / fps)) < SLOW
    stands = (~flies & slow & (low < NEAR)) | (low <= 0)
    frames = np.arange(len(low))
    floor = level + gaussian_filter1d(np.interp(frames, frames[stands], low[stands]), SMOOTH * fps)
    return floor[len(qpos) - 1 :][: len(qpos)] if loop else floor
