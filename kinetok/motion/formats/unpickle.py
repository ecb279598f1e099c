"""Foreign pickles as data: numbers, text, containers and arrays. Nothing is imported and nothing is called.

    data = load_plain(path.read_bytes(), path)        # usually a dict of numpy arrays

A pickle is a program for a stack machine. This file never runs it: `pickletools` reads the instructions, a stack
of our own follows them, and where the program names a class only the few below have a meaning here, each as plain
data: numpy's arrays, dtypes and scalars, OrderedDict, torch's tensors (over a `storage` the caller supplies) and one
enumeration of ProtoMotions. Refused with the byte and the name: every other class, and arrays that claim more than
the file holds.
"""

import math
import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kinetok.motion.error import FormatError
from kinetok.motion.formats.fields import LIMIT

ARRAYS = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
SCALARS = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
BUFFERS = ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer")
VALUES = ("protomotions.simulator.base_simulator.simulator_state.StateConversion",)
STORAGES = {
    "torch.DoubleStorage": "<f8", "torch.FloatStorage": "<f4", "torch.HalfStorage": "<f2", "torch.LongStorage": "<i8",
    "torch.IntStorage": "<i4", "torch.ShortStorage": "<i2", "torch.CharStorage": "<i1", "torch.ByteStorage": "<u1",
    "torch.BoolStorage": "?",
}  # fmt: skip
KEYS = (str, bytes, int, float, bool, type(None))
BROKEN = (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError)


@dataclass(frozen=True)
class Named:
    """A class or function the pickle names: a name, never the thing."""

    name: str


@dataclass(eq=False)
class Kind:
    """A numpy dtype in the making: its code ("f8") and byte order."""

    code: str
    order: str = "="

    def dtype(self) -> np.dtype:
        if self.code.lstrip("<>=|")[:1] not in tuple("biufSU"):
            raise ValueError(f"numpy dtype {self.code!r} is not of numbers or text")
        return np.dtype(self.code).newbyteorder(">" if self.order == ">" else "<")


@dataclass(eq=False)
class Blank:
    """An array before its contents arrived, and the memo entries that wait for it."""

    slots: list[int] = field(default_factory=list)


class Refused(ValueError):
    """What the pickle asks for has no meaning as data."""


def load_plain(data: bytes, path: Path, *, storage: Callable[[str], bytes] | None = None) -> object:
    """The value a pickle describes. `storage` gives the bytes of a torch storage by its key; without it a pickle that
    names one is refused. An array of Python objects becomes the list of them, or the object when it has no axes."""
    machine, where = Machine(storage), 0
    try:
        for opcode, argument, position in pickletools.genops(data):
            where = position
            if opcode.name == "STOP":
                (value,) = machine.stack
                return value
            machine.step(opcode.name, argument)
    except FormatError:
        raise
    except Refused as error:
        raise FormatError(path, f"pickle, byte {where}", str(error)) from None
    except BROKEN as error:
        raise FormatError(path, f"pickle, byte {where}", f"damaged or cut off: {error}") from None
    raise FormatError(path, f"pickle, byte {where}", "cut off: it has no end")


def load_dict(path: Path) -> dict:
    """The dict a pickle file holds."""
    value = load_plain(path.read_bytes(), path)
    if not isinstance(value, dict):
        raise FormatError(path, "pickle", f"holds a {type(value).__name__}; a motion is a dict")
    return value


class Machine:
    """The stack, the stacks below the open marks and the memo of one pickle."""

    def __init__(self, storage: Callable[[str], bytes] | None):
        self.stack: list = []
        self.below: list[list] = []
        self.memo: dict[int, object] = {}
        self.storage = storage

    def step(self, name: str, argument) -> None:
        """Follow one instruction."""
        stack = self.stack
        if name in PUSHED:
            stack.append(argument)
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name]())
        elif name in ("PROTO", "FRAME"):
            pass
        elif name == "MARK":
            self.below.append(stack)
            self.stack = []
        elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            slot = len(self.memo) if name == "MEMOIZE" else argument
            self.memo[slot] = stack[-1]
            if isinstance(stack[-1], Blank):
                stack[-1].slots.append(slot)
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(self.memo[argument])
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            count = int(name[-1])
            stack[-count:] = [tuple(stack[-count:])]
        elif name in ("TUPLE", "LIST", "FROZENSET", "DICT", "APPENDS", "SETITEMS", "ADDITEMS", "POP_MARK"):
            self.gather(name)
        elif name == "APPEND":
            self.extend([stack.pop()])
        elif name == "SETITEM":
            value = stack.pop()
            self.fill([stack.pop(), value])
        elif name == "POP":
            stack.pop()
        elif name == "DUP":
            stack.append(stack[-1])
        elif name == "GLOBAL":
            stack.append(Named(argument.replace(" ", ".")))
        elif name == "STACK_GLOBAL":
            attribute = stack.pop()
            stack.append(Named(f"{stack.pop()}.{attribute}"))
        elif name in ("REDUCE", "NEWOBJ"):
            arguments = stack.pop()
            stack.append(make(stack.pop(), arguments))
        elif name == "BUILD":
            self.build(stack.pop())
        elif name == "BINPERSID":
            stack.append(self.open(stack.pop()))
        else:
            raise Refused(f"instruction {name} has no place in a file of arrays")

    def gather(self, name: str) -> None:
        items, self.stack = self.stack, self.below.pop()
        if name == "TUPLE":
            self.stack.append(tuple(items))
        elif name == "LIST":
            self.stack.append(items)
        elif name == "FROZENSET":
            self.stack.append(list(items))
        elif name == "DICT":
            self.stack.append({})
            self.fill(items)
        elif name == "SETITEMS":
            self.fill(items)
        elif name in ("APPENDS", "ADDITEMS"):
            self.extend(items)

    def extend(self, items: list) -> None:
        if not isinstance(self.stack[-1], list):
            raise Refused(f"items are added to a {type(self.stack[-1]).__name__}, not to a list")
        self.stack[-1].extend(items)

    def fill(self, items: list) -> None:
        into = self.stack[-1]
        if not isinstance(into, dict) or not all(isinstance(key, KEYS) for key in items[::2]):
            raise Refused("entries are set with keys that are not text or numbers, or not in a dict")
        into.update(zip(items[::2], items[1::2], strict=True))

    def build(self, state) -> None:
        """The state of a dtype or an array; replaces the blank by the array wherever it stands already."""
        target = self.stack[-1]
        if isinstance(target, Kind):
            target.order = str(state[1])
            if state[3] is not None or state[2] is not None:
                raise Refused("a numpy dtype with fields or parts; store plain arrays of numbers")
        elif isinstance(target, Blank):
            shape, kind, fortran, contents = state[-4:]
            value = listed(shape, contents) if kind.code[:1] == "O" else filled(contents, kind, shape, fortran)
            self.stack[-1] = value
            for slot in target.slots:
                self.memo[slot] = value
        else:
            raise Refused(f"a state is set on a {type(target).__name__}; only arrays have one here")

    def open(self, identity) -> np.ndarray:
        """The storage a torch tensor looks into: ("storage", class, key, device, count)."""
        if self.storage is None:
            raise Refused("refers to data outside the pickle")
        _, kind, key, _, count = identity
        if kind.name not in STORAGES:
            raise Refused(f"{kind.name} is not read; known: {', '.join(STORAGES)}")
        dtype, contents = np.dtype(STORAGES[kind.name]), self.storage(str(key))
        if count * dtype.itemsize > len(contents):
            raise Refused(f"storage {key} claims {count} values; the file holds {len(contents) // dtype.itemsize}")
        return np.frombuffer(contents, dtype, count=count)


def make(what, arguments: tuple) -> object:
    """What a pickle calls, as data."""
    name = what.name if isinstance(what, Named) else type(what).__name__
    if name in ARRAYS:
        return Blank()
    if name == "numpy.dtype":
        return Kind(str(arguments[0]))
    if name in SCALARS:
        return filled(arguments[1], arguments[0], (), False)[()]
    if name in BUFFERS:
        contents, kind, shape, order = arguments
        return filled(contents, kind, shape, order == "F")
    if name == "collections.OrderedDict":
        if arguments and not all(isinstance(key, KEYS) for key, _ in arguments[0]):
            raise Refused("an OrderedDict with keys that are not text or numbers")
        return dict(arguments[0]) if arguments else {}
    if name == "_codecs.encode" and arguments[1:] == ("latin1",):
        return arguments[0].encode("latin1")
    if name in ("__builtin__.bytes", "builtins.bytes") and not arguments:
        return b""
    if name == "torch._utils._rebuild_tensor_v2":
        return tensor(*arguments[:4])
    if name in VALUES:
        return arguments[0]
    raise Refused(
        f"the class {name!r} is not plain data and is not loaded: a foreign class can run anything. Save the motion "
        "as a dict of numpy arrays and numbers"
    )


def filled(contents, kind: Kind, shape: tuple, fortran: bool) -> np.ndarray:
    """An array over the bytes of the pickle."""
    contents = contents.encode("latin1") if isinstance(contents, str) else contents
    dtype, count = kind.dtype(), counted(shape)
    if count * dtype.itemsize != len(contents):
        raise Refused(f"an array claims shape {shape} of {dtype}; the pickle holds {len(contents)} bytes of it")
    return np.frombuffer(contents, dtype, count=count).reshape(shape, order="F" if fortran else "C")


def listed(shape: tuple, contents: list) -> object:
    if counted(shape) != len(contents) or len(shape) > 1:
        raise Refused(f"an array of objects of shape {shape} holds {len(contents)} of them")
    return contents if shape else contents[0]


def tensor(storage: np.ndarray, offset: int, size: tuple, stride: tuple) -> np.ndarray:
    """The view of a storage that a torch tensor is; no copy."""
    count = counted(size)
    last = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True))
    if min(offset, *stride, 0) < 0 or (count and last >= len(storage)) or count > LIMIT:
        raise Refused(f"a tensor of size {size}, stride {stride} does not fit its storage of {len(storage)} values")
    if not count:
        return np.empty(size, storage.dtype)
    steps = tuple(s * storage.itemsize for s in stride)
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps, writeable=False)


def counted(shape: tuple) -> int:
    if not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 8:
        raise Refused(f"{shape!r} is no shape")
    return math.prod(shape)


CONSTANTS: dict[str, Callable[[], object]] = {
    "NONE": lambda: None, "NEWTRUE": lambda: True, "NEWFALSE": lambda: False, "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple, "EMPTY_DICT": dict, "EMPTY_SET": list,
}  # fmt: skip
PUSHED = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES",
    "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
