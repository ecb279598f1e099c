"""returns.py: generalised advantages with the arithmetic written out."""

import torch

from kinetok.rl.returns import gae

GAMMA, LAM = 0.5, 0.5  # gamma * lam = 0.25


def column(*values):
    return torch.tensor(values)[:, None]


def run(rewards, values, next_values, done):
    advantages, targets = gae(
        column(*rewards), column(*values), column(*next_values), column(*done), gamma=GAMMA, lam=LAM
    )
    return advantages[:, 0], targets[:, 0]


def test_three_running_steps():
    # delta = r + .5 V' - V: 1 + .5*4 - 2 = 1;  0 + .5*6 - 4 = -1;  2 + .5*8 - 6 = 0
    # A_2 = 0;  A_1 = -1 + .25*0 = -1;  A_0 = 1 + .25*-1 = .75
    advantages, targets = run([1.0, 0.0, 2.0], [2.0, 4.0, 6.0], [4.0, 6.0, 8.0], [False] * 3)
    torch.testing.assert_close(advantages, torch.tensor([0.75, -1.0, 0.0]))
    torch.testing.assert_close(targets, torch.tensor([2.75, 3.0, 6.0]))


def test_a_terminated_step_has_no_future():
    # step 1 ended in failure: V' = 0, nothing flows back from step 2 of the next episode
    # delta: 1;  0 + 0 - 4 = -4;  2 + .5*8 - 6 = 0     A_1 = -4;  A_0 = 1 + .25*-4 = 0
    advantages, _ = run([1.0, 0.0, 2.0], [2.0, 4.0, 6.0], [4.0, 0.0, 8.0], [False, True, False])
    torch.testing.assert_close(advantages, torch.tensor([0.0, -4.0, 0.0]))


def test_a_truncated_step_keeps_the_value_of_its_last_state():
    # step 1 ran out of time in a state worth 10: delta = 0 + .5*10 - 4 = 1; step 2 (delta 2 + 4 - 1 = 5) is another
    # episode and does not flow back.  A_1 = 1;  A_0 = 1 + .25*1 = 1.25
    advantages, targets = run([1.0, 0.0, 2.0], [2.0, 4.0, 1.0], [4.0, 10.0, 8.0], [False, True, False])
    torch.testing.assert_close(advantages, torch.tensor([1.25, 1.0, 5.0]))
    torch.testing.assert_close(targets, torch.tensor([3.25, 5.0, 6.0]))


def test_rows_are_independent_and_lambda_one_is_the_return():
    generator = torch.Generator().manual_seed(0)
    rewards, values = torch.randn(6, 3, generator=generator), torch.randn(7, 3, generator=generator)
    done = torch.zeros(6, 3, dtype=torch.bool)
    advantages, targets = gae(rewards, values[:-1], values[1:], done, 0.9, 1.0)
    discounts = 0.9 ** torch.arange(6)[:, None]
    torch.testing.assert_close(targets[0], (discounts * rewards).sum(0) + 0.9**6 * values[-1])
    alone, _ = gae(rewards[:, :1], values[:-1, :1], values[1:, :1], done[:, :1], 0.9, 1.0)
    torch.testing.assert_close(advantages[:, :1], alone)
