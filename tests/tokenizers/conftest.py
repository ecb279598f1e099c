"""A motion that needs no data: the humanoid stands on both feet and slowly waves its arms."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import lowest_point
from kinetok.motion.library import ClipLibrary
from kinetok.presets import FIT
from kinetok.sim.tasks.tracking import ReferenceTable
from kinetok.tokenizers.fit import FitConfig, new_tokenizer
from kinetok.tokenizers.tokenizer import MotionTokenizer


@pytest.fixture(autouse=True, scope="package")
def one_thread():
    """Nets this small are faster on one thread, by ten times where other work runs beside the tests."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def make_wave(name: str, seconds: float = 1.0, *, loop: bool = False, reach: float = 0.5) -> Clip:
    """Both shoulders swing by `reach` radians once; the lowest point touches the floor."""
    body = Character.load("humanoid")
    frames = round(30 * seconds) + 1
    angle = reach * np.sin(2 * np.pi * np.arange(frames) / (frames - 1))
    qpos = np.tile(body.model.qpos0, (frames, 1))
    for joint, axis in (("left_shoulder", [1.0, 0.0, 0.0]), ("right_shoulder", [0.0, 1.0, 0.0])):
        at = int(body.model.joint(joint).qposadr[0])
        qpos[:, at : at + 4] = rotation.from_rotvec(np.outer(angle, axis))
    qpos[:, 2] -= lowest_point(body, qpos[:1])
    return Clip(name=name, character="humanoid", fps=30.0, qpos=qpos, loop=loop)


@pytest.fixture(scope="session")
def wave() -> Callable[..., Clip]:
    return make_wave


@pytest.fixture(scope="session")
def standing() -> ReferenceTable:
    """Two clips of one second that end."""
    return ReferenceTable(ClipLibrary.of([make_wave("wave"), make_wave("sweep", reach=-0.8)]))


@pytest.fixture(scope="session")
def small() -> FitConfig:
    return FIT["tiny"]()


@pytest.fixture
def student(small, standing) -> MotionTokenizer:
    return new_tokenizer(small.tokenizer, standing, 0)


@pytest.fixture(scope="session")
def cut_off() -> Callable:
    """cut_off(module, n, run): call `run`, whose n-th evaluation in `module` is cut off as by Ctrl-C."""

    def interrupt(module, count: int, run: Callable) -> None:
        real, calls = module.track, []

        def track(*args, **kwargs):
            calls.append(1)
            if len(calls) == count:
                raise KeyboardInterrupt
            return real(*args, **kwargs)

        with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(module, "track", track)
            run()

    return interrupt


@pytest.fixture(autouse=True)
def apart(tmp_path, monkeypatch) -> Path:
    """MuJoCo writes its log of blown-up simulations to the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
