"""average.py: the mean of the weights by hand, in the place of the weights and out of it again."""

import pytest
import torch
from torch import nn

from kinetok.rl.average import Average


def test_the_average_of_three_updates_by_hand():
    weight = nn.Parameter(torch.tensor([0.0]))
    average = Average([weight], 0.9)
    mean = 0.0
    for count, value in enumerate([1.0, 5.0, -2.0], 1):
        weight.data.fill_(value)
        average.follow()
        share = 1 - min(0.9, (1 + count) / (4 + count))
        mean = (1 - share) * mean + share * value
    with average.standing_in():
        assert weight.item() == pytest.approx(mean)
    assert weight.item() == -2.0


def test_weights_come_back_after_an_error_and_the_average_from_its_state():
    weight = nn.Parameter(torch.tensor([1.0, 2.0]))
    average = Average([weight], 0.5)
    weight.data.fill_(9.0)
    average.follow()
    with pytest.raises(RuntimeError), average.standing_in():
        raise RuntimeError
    assert weight.tolist() == [9.0, 9.0]
    other = Average([nn.Parameter(torch.zeros(2))], 0.5)
    other.load_state_dict(average.state_dict())
    assert other.count == 1 and torch.equal(other.means[0], average.means[0])
