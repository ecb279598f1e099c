"""Shared fixtures: the motion data beside the repository, and characters small enough to work out by hand."""

from pathlib import Path

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.character import Character, from_mjcf
from kinetok.motion.clip import Clip
from kinetok.motion.formats import read_deepmimic
from kinetok.motion.library import ClipLibrary
from kinetok.sim.tasks.tracking import ReferenceTable

DATA = Path(__file__).parents[2] / "shared" / "data"

TINY = """
<mujoco model="tiny">
  <worldbody>
    <body name="base">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3" mass="2"/>
      <body name="arm" pos="0 0 0.5">
        <joint name="shoulder" type="ball" damping="3"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="0.05" mass="1"/>
        <body name="hand" pos="0 0 1">
          <joint name="wrist" type="hinge" axis="0 1 0" damping="1"/>
          <geom type="sphere" size="0.1" mass="1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="sx" joint="shoulder" gear="1 0 0" kp="30" forcerange="-5 5"/>
    <position name="sy" joint="shoulder" gear="0 1 0" kp="30" forcerange="-5 5"/>
    <position name="sz" joint="shoulder" gear="0 0 1" kp="30" forcerange="-5 5"/>
    <position name="wrist" joint="wrist" kp="20" kv="2"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="session")
def data_dir() -> Path:
    if not DATA.is_dir():
        pytest.skip("motion data is absent: tests on recorded clips read ../shared/data beside the repository")
    return DATA


@pytest.fixture(scope="session")
def humanoid() -> Character:
    return Character.load("humanoid")


@pytest.fixture(scope="session")
def tiny() -> Character:
    """A box with an arm (ball joint) and a hand (hinge): nq 12, nv 10, nu 4."""
    return from_mjcf("tiny", TINY, {"hands": ["hand"], "head": "base"})


@pytest.fixture(scope="session")
def walk(data_dir):
    return read_deepmimic(data_dir / "train" / "deepmimic" / "humanoid3d_walk.txt")


@pytest.fixture(scope="session")
def jog(data_dir):
    return read_deepmimic(data_dir / "train" / "deepmimic" / "humanoid3d_jog.txt")


@pytest.fixture(scope="session")
def getup(data_dir):
    """A clip that is no loop, cut to one second."""
    return read_deepmimic(data_dir / "train" / "deepmimic" / "humanoid3d_getup_facedown.txt").slice(0.0, 1.0)


@pytest.fixture(scope="session")
def library(walk, getup) -> ClipLibrary:
    return ClipLibrary.of([walk, getup])


def sway(name: str, frames: int, *, loop: bool, fps: float = 30.0) -> Clip:
    """A made clip of the humanoid: it glides along x at 0.3 m/s, turns a little and bends an elbow and a hip."""
    body, t = Character.load("humanoid"), np.arange(frames) / (frames - 1)
    qpos = np.tile(body.model.qpos0, (frames, 1))
    qpos[:, 0], qpos[:, 2] = 0.3 * np.arange(frames) / fps, 0.89
    qpos[:, 3:7] = rotation.about_z(0.2 * np.sin(2 * np.pi * t))
    qpos[:, body.hinge[0, 0]] = 0.5 + 0.4 * np.sin(2 * np.pi * t)
    hip = int(body.model.joint("left_hip").qposadr[0])
    qpos[:, hip : hip + 4] = rotation.from_rotvec(np.outer(np.sin(2 * np.pi * t), [0.0, 0.2, 0.1]))
    return Clip(name=name, character="humanoid", fps=fps, qpos=qpos, loop=loop)


@pytest.fixture(scope="session")
def table() -> ReferenceTable:
    """Two made clips: a loop of 1 s unrolled to 3 s, and a clip of 0.5 s that ends."""
    library = ClipLibrary.of([sway("cycle", 31, loop=True), sway("once", 16, loop=False)])
    return ReferenceTable(library, control_hz=30, seconds=2.0)
