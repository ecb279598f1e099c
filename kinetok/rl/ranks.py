"""One PPO training in several processes that torchrun started, on one machine or on many.

    torchrun --nproc-per-node 4 -m kinetok.cli finetune --task target --out runs/target

    with joined():                             # what torchrun says of this process
        finetune(prior, config, out, base=base)

Every process (a rank) has its share of the worlds and of each minibatch, and draws its own random numbers; gradients,
divergences and the observations' statistics are means over all of them, so that weights are the same everywhere and a
rollout and an update are as large as one process would have them. The first rank evaluates and writes; every rank
writes a state of its own to go on from. `out` lies where all of them see it. Alone, without torchrun, nothing here does
anything.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TypeVar

import torch
import torch.distributed as distributed

# Its functions' default group is the one there is when it is imported, which an optimizer does; imported after ours is
# made, it would keep the group's threads beyond the group's end, and they may abort the process as that ends.
import torch.distributed.nn.functional
from torch import Tensor

from kinetok.config import ConfigError

T = TypeVar("T")
PATIENCE = timedelta(hours=2)  # how long ranks wait for the first one's evaluation


@contextmanager
def joined() -> Iterator[None]:
    """Be one of the processes that torchrun started; nothing to do where it started none."""
    if launched() == 1:
        yield
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    distributed.init_process_group(backend, timeout=PATIENCE)
    try:
        yield
    finally:
        distributed.destroy_process_group()


def launched() -> int:
    """How many processes torchrun started, 1 without it."""
    return int(os.environ.get("WORLD_SIZE", 1))


def alone(what: str) -> None:
    """ConfigError where torchrun started several processes of what only one can do."""
    if launched() > 1:
        raise ConfigError(
            f"{what} is done by one process, and torchrun started {launched()}: do it without torchrun, "
            "and go on from it with what PPO does (tokenize fit --stages ppo, finetune --method rl)"
        )


def size() -> int:
    """How many processes train together."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Which of them this is, from 0."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def own(seed: int) -> int:
    """A seed of this rank's own; the first one's is `seed`."""
    return seed + 100_003 * rank()


def named(stem: str) -> str:
    """A file name of this rank's own; the first one's is `stem`."""
    return f"{stem}-{rank()}" if rank() else stem


def share(count: int, what: str) -> int:
    """This rank's part of `count` worlds or samples."""
    if count % size():
        raise ConfigError(f"{what} is {count}, which {size()} processes cannot share evenly; choose a multiple")
    return count // size()


def threads(count: int) -> int:
    """Threads of physics: `count`, or where that is 0 this process's part of the machine's cores."""
    here = int(os.environ.get("LOCAL_WORLD_SIZE", 1))
    return count if count or here == 1 else max((os.cpu_count() or 1) // here, 1)


@torch.no_grad()
def average_(tensors: Iterable[Tensor]) -> None:
    """Make tensors of one type their means over all ranks, in place."""
    if size() == 1:
        return
    tensors = list(tensors)
    flat = torch.cat([tensor.reshape(-1) for tensor in tensors]) / size()
    distributed.all_reduce(flat)
    for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(part.view_as(tensor))


def gathered(tensor: Tensor) -> Tensor:
    """The tensors (K, ...) of all ranks, one after the other; as many of each."""
    if size() == 1:
        return tensor
    parts = [torch.empty_like(tensor) for _ in range(size())]
    distributed.all_gather(parts, tensor.contiguous())
    return torch.cat(parts)


def first(make: Callable[[], T]) -> T:
    """What the first rank makes, told to the others, which wait for it."""
    if size() == 1:
        return make()
    made: list = [make() if rank() == 0 else None]
    distributed.broadcast_object_list(made)
    return made[0]
