"""replay.py: what is replayed is what would have been computed, whatever has changed in place since."""

import pytest
import torch

from kinetok.adapters import CoLAConfig
from kinetok.adapters.adapted import Adapted
from kinetok.adapters.rlft import TokenPolicy, TokenPolicyConfig
from kinetok.gpt import GPT, GPTConfig
from kinetok.gpt.replay import Replay
from kinetok.rl.rollout import seeded
from kinetok.tokenizers.layout import TokenLayout

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.fixture(autouse=True)
def on_gpu():
    with torch.device("cuda"):
        yield


def test_a_replay_reads_arguments_and_weights_as_they_are_now():
    layer = torch.nn.Linear(3, 2).requires_grad_(False)
    replay = Replay(lambda x, y: (layer(x) + y, x * 2))
    for _ in range(3):
        x, y = torch.randn(5, 3), torch.randn(5, 2)
        kept = replay(x, y)
        torch.testing.assert_close(kept, (layer(x) + y, x * 2))
        layer.weight.add_(1.0)
        torch.testing.assert_close(replay(x, y)[0], layer(x) + y)
        torch.testing.assert_close(kept[1], x * 2)  # new tensors each time


class Decoder:
    def __init__(self, layout: TokenLayout):
        self.layout = layout

    def decode(self, codes, state):
        return codes.float()


def test_a_policy_draws_on_a_gpu_what_it_draws_on_a_cpu():
    layout = TokenLayout.grouped(6, 5, 3)
    torch.manual_seed(0)
    config = GPTConfig(
        state_dim=4, tokens_per_step=2, scalars=3, levels=5, width=16, layers=2, heads=2, head="factorised"
    )
    with torch.device("cpu"):
        there = Adapted(GPT(config), CoLAConfig(rank=2, alpha=4.0, hidden=8), 2)
        torch.manual_seed(1)
        for parameter in there.trainable():
            torch.nn.init.normal_(parameter, std=0.3)
    here = Adapted(GPT(config), CoLAConfig(rank=2, alpha=4.0, hidden=8), 2)
    here.load_state_dict(there.state_dict())
    obs = torch.randn(64, 6, generator=seeded(3))
    settings = TokenPolicyConfig(top_p=0.9, temperature=0.8)
    mine, its = TokenPolicy(here, Decoder(layout), settings), TokenPolicy(there, Decoder(layout), settings)
    for _ in range(3):
        _, taken = mine.draw(obs, seeded(0))
        again = mine.draw(obs, seeded(0))[1]
        assert all(torch.equal(taken[name], again[name]) for name in taken)
        # The same tokens are as probable there, and what was kept is what is kept there.
        with torch.device("cpu"):
            judged = its.assess(obs.cpu(), {name: x.cpu() for name, x in taken.items()})
        torch.testing.assert_close(judged.log_prob.detach(), taken["log_prob"].cpu(), rtol=1e-3, atol=1e-3)
        with torch.no_grad():
            for one, other in zip(here.trainable(), there.trainable(), strict=True):
                one.mul_(1.1)
                other.mul_(1.1)
