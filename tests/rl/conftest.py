import pytest
import torch


@pytest.fixture(autouse=True, scope="package")
def one_thread():
    """Nets this small are faster on one thread, by ten times where other work runs beside the tests."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
