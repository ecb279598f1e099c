"""cycle.py: the cycle of a gait that was made of one is found, closed and repeats; what is none is refused."""

from dataclasses import replace

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.cycle import cycle

PERIOD = 1.2


def gait(seconds: float, fps: float = 30.0, lead: float = 0.0) -> Clip:
    """Thighs and shoulders swing with a period of 1.2 s as the root goes ahead; it stands for `lead` seconds first."""
    body, times = Character.load("humanoid"), np.arange(0, seconds, 1 / fps)
    qpos = np.tile(body.stand(), (len(times), 1))
    phase = np.maximum(times - lead, 0)
    qpos[:, 0] = phase
    for joint, sign in (("left_hip", 1.0), ("right_hip", -1.0), ("left_shoulder", -0.7), ("right_shoulder", 0.7)):
        at = int(body.model.joint(joint).qposadr[0])
        swing = 0.5 * sign * np.sin(2 * np.pi * phase / PERIOD)
        qpos[:, at : at + 4] = rotation.from_rotvec(np.outer(swing, [0.0, 1.0, 0.0]))
    return Clip(name="gait", character="humanoid", fps=fps, qpos=qpos)


@pytest.mark.parametrize("fps", [30.0, 120.0])
@pytest.mark.parametrize("lead", [0.0, 1.0])
def test_the_cycle_of_a_gait_is_found_and_goes_on(fps, lead):
    found = cycle(gait(lead + 4.0, fps, lead))
    assert found.loop and found.seconds == pytest.approx(PERIOD, abs=1 / 30 + 1e-6)
    assert found.qpos[-1, 0] - found.qpos[0, 0] == pytest.approx(PERIOD, abs=0.05)
    np.testing.assert_allclose(found.qpos[-1, 2:], found.qpos[0, 2:], atol=1e-9)
    start = float(found.source.split()[0])
    assert start >= lead - 0.1  # not in the standing that it begins with
    path = np.diff(found.at(np.arange(0, 5, 1 / 30))[:, 0]) * 30
    np.testing.assert_allclose(path, 1.0, atol=0.1)  # no halt where cycles meet


def test_what_holds_no_cycle_is_refused():
    with pytest.raises(ValueError, match=r"is a loop already"):
        cycle(replace(gait(3.0), loop=True))
    with pytest.raises(ValueError, match=r"no cycle of 0\.5 to 2\.5 s; the two frames most alike differ by"):
        cycle(gait(0.9))  # less than one
    with pytest.raises(ValueError, match=r"0\.37 s hold no cycle of 0\.5 s"):
        cycle(gait(0.4))
    with pytest.raises(ValueError, match=r"it stands still"):
        cycle(replace(gait(3.0), qpos=np.tile(gait(3.0).qpos[:1], (90, 1))))  # who stands
    with pytest.raises(ValueError, match=r"longest is more than shortest"):
        cycle(gait(3.0), shortest=2.0, longest=1.0)
