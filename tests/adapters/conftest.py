from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from made import make_clips, make_prior

from kinetok.gpt.controller import Prior
from kinetok.motion.clip import Clip


@pytest.fixture(autouse=True, scope="package")
def one_thread() -> Iterator[None]:
    """Nets this small are faster on one thread, by ten times where other work runs beside the tests."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="package")
def models(tmp_path_factory, table) -> Path:
    """A directory with an untrained `prior` and its `tokenizer`."""
    path = tmp_path_factory.mktemp("models")
    make_prior(path, table)
    return path


@pytest.fixture
def prior(models) -> Prior:
    return Prior.from_pretrained(models / "prior")


@pytest.fixture(scope="package")
def clips(table) -> list[Clip]:
    return make_clips(table)


@pytest.fixture(autouse=True)
def apart(tmp_path, monkeypatch) -> None:
    """MuJoCo writes its log of blown-up simulations to the working directory."""
    monkeypatch.chdir(tmp_path)
