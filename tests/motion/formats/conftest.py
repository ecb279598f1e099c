"""A made motion of the G1 whose every number is known: a squat on flat soles, facing 0.5 rad off x."""

from dataclasses import dataclass

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.clip import Clip
from kinetok.motion.formats.g1 import JOINTS, load_g1
from kinetok.motion.kinematics import kinematics, lowest_point

LEGS = [(f"{side}_{name}", sign) for side in ("left", "right") for name, sign in
        (("hip_pitch", -1), ("knee", 2), ("ankle_pitch", -1))]  # fmt: skip


@dataclass(frozen=True)
class G1Motion:
    """root (T, 3), quats (T, 4) wxyz, joints (T, 29); fps; feet stay where they are."""

    fps: float
    root: np.ndarray
    quats: np.ndarray
    joints: np.ndarray

    @property
    def qpos(self) -> np.ndarray:
        return np.concatenate([self.root, self.quats, self.joints], axis=1)

    @property
    def xyzw(self) -> np.ndarray:
        return self.quats[:, [1, 2, 3, 0]]

    def clip(self, name: str = "squat") -> Clip:
        return Clip(name=name, character="g1", fps=self.fps, qpos=self.qpos)


@pytest.fixture(scope="session")
def squat() -> G1Motion:
    body, frames, heading = load_g1("g1"), 40, 0.5
    bend = 0.3 + 0.25 * np.sin(np.linspace(0, 2 * np.pi, frames))
    qpos = np.zeros((frames, 36))
    qpos[:, 3:7], qpos[:, 7 + JOINTS.index("left_elbow")] = rotation.about_z(np.full(frames, heading)), bend
    for name, sign in LEGS:
        qpos[:, 7 + JOINTS.index(name)] = sign * bend
    qpos[:, :3] -= kinematics(body, qpos, 30.0).xpos[:, body.body_names.index("left_ankle_roll_link")]
    qpos[:, 2] -= lowest_point(body, qpos)
    return G1Motion(30.0, qpos[:, :3], qpos[:, 3:7], qpos[:, 7:])
