"""How the task observation c enters an adapted GPT: normalised, as a task token, and as FiLM in rank space.

    conditioner = Conditioner(cond_dim=2, token=Token(cond_dim=2, hidden=64, width=128), film=None)
    conditioner.observe(c)                                # move the running statistics, between updates
    conditioner.fill(condition, c)                        # before each forward: what the layers read

The task token (GPC sec. 2.4, "a learned task token"; the paper gives no form) is a small net of c whose output is
added to the encoded state at position 0, which every later position attends to. Departure: a token of its own in
the sequence would change the base's positions. The last layer of every net here starts at zero, so that at the
start c changes nothing.
"""

import torch.nn.functional as F
from torch import Tensor, nn

from kinetok.adapters.cola import Film
from kinetok.adapters.inject import Condition
from kinetok.rl.normalize import RunningNorm


class Token(nn.Module):
    """The task token: c (N, C), normalised -> one hidden layer -> (N, width)."""

    def __init__(self, cond_dim: int, hidden: int, width: int):
        super().__init__()
        self.trunk = nn.Linear(cond_dim, hidden)
        self.out = nn.Linear(hidden, width)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, c: Tensor) -> Tensor:
        return self.out(F.gelu(self.trunk(c)))


class TokenEncoder(nn.Sequential):
    """The layers of a state encoder, under their old names, and the task token added to what they give."""

    def __init__(self, encoder: nn.Sequential, condition: Condition):
        super().__init__(*encoder)
        self.condition = condition

    def forward(self, input: Tensor) -> Tensor:
        if self.condition.token is None:
            raise ValueError("the condition is not set; run the encoder through its adapted model, with c")
        return super().forward(input) + self.condition.token


class Conditioner(nn.Module):
    """The nets that read c (N, cond_dim), and the statistics that normalise it. token, film: None where c does not
    enter that way."""

    def __init__(self, cond_dim: int, *, token: Token | None, film: Film | None):
        super().__init__()
        self.norm = RunningNorm(cond_dim)
        self.token, self.film = token, film

    def fill(self, condition: Condition, c: Tensor) -> None:
        """Have the layers that hold `condition` read c."""
        c = self.norm(c)
        condition.token = None if self.token is None else self.token(c)
        condition.film = {} if self.film is None else self.film(c)

    def observe(self, c: Tensor) -> None:
        """Merge a batch (..., cond_dim) into the statistics."""
        self.norm.observe(c)
