"""normalize.py: batches merge into the statistics of all data; what is not finite is refused."""

import pytest
import torch

from kinetok.rl.normalize import RunningNorm


def test_batches_merge_into_the_statistics_of_all_data():
    generator = torch.Generator().manual_seed(0)
    x = 3 + torch.randn(1000, 4, generator=generator) * torch.tensor([0.1, 1.0, 5.0, 30.0])
    norm = RunningNorm(4)
    for part in x.split([1, 99, 400, 500]):
        norm.observe(part)
    torch.testing.assert_close(norm.mean, x.mean(0), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(norm.var, x.var(0, unbiased=False), rtol=1e-3, atol=1e-4)
    assert float(norm.count) == 1000
    y = norm(x)
    torch.testing.assert_close(y.mean(0), torch.zeros(4), atol=5e-3, rtol=0)
    torch.testing.assert_close(y[:, 1:].std(0), torch.ones(3), atol=1e-2, rtol=0)


def test_leading_shapes_and_clip():
    norm = RunningNorm(2, clip=3.0)
    norm.observe(torch.tensor([[[1.0, 0.0]], [[-1.0, 0.0]]]))
    assert float(norm.count) == 2
    assert norm(torch.tensor([1e6, -1e6])).tolist() == [3.0, -3.0]


def test_forward_does_not_move_the_statistics():
    norm = RunningNorm(2).train()
    norm(torch.ones(5, 2))
    assert float(norm.count) == 0 and norm.mean.tolist() == [0, 0]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_refused_and_changes_nothing(value):
    norm = RunningNorm(2)
    with pytest.raises(FloatingPointError, match="observations hold a value that is not finite"):
        norm.observe(torch.tensor([[0.0, value]]))
    assert float(norm.count) == 0 and torch.isfinite(norm.mean).all()
