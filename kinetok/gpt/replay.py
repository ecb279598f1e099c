"""A function of tensors as a CUDA graph: recorded at its first call, replayed at every later one.

    choose = Replay(function) if state.device.type == "cuda" else function
    tokens, log_prob = choose(state, uniform)                      # new tensors each time

Drawing the tokens of a step is some 1,700 operations, most of them small, which a GPU does faster than Python can ask
for. What is not an argument is read where it lay at the first call: weights have to change in place, as optimizers
change them. The function may not look at the value of a tensor.
"""

from collections.abc import Callable

import torch
from torch import Tensor

WARM_UP = 2  # calls before recording, in which libraries set themselves up


class Replay:
    """The same as `function`, which maps tensors of fixed shapes to a tuple of tensors."""

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]):
        self._function = function
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: tuple[Tensor, ...] = ()
        self._outputs: tuple[Tensor, ...] = ()

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        if self._graph is None:
            self._record(inputs)
        assert self._graph is not None
        for mine, given in zip(self._inputs, inputs, strict=True):
            mine.copy_(given)
        self._graph.replay()
        return tuple(output.clone() for output in self._outputs)

    def _record(self, inputs: tuple[Tensor, ...]) -> None:
        self._inputs = tuple(x.clone() for x in inputs)
        beside = torch.cuda.Stream()
        beside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(beside):
            for _ in range(WARM_UP):
                self._function(*self._inputs)
        torch.cuda.current_stream().wait_stream(beside)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._outputs = self._function(*self._inputs)
