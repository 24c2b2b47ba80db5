"""TickRecorder: operations of torch, as they come, as texts of Python for NumPy arrays."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from rare_envs.simulation.recorded.array_operations import COPYING, FUNCTIONS, MAKING, NUMERIC, write_operation


@dataclass(frozen=True)
class RecordedOperation:
    """An operation."""

    results: tuple[str, ...]
    """Names of what it computes; of what it writes to in an operation in place."""
    text: str
    reads: tuple[str, ...]
    """Names."""


@dataclass
class Part:
    """Operations up to a look or to the end of a tick."""

    steps: list[RecordedOperation] = field(default_factory=list)
    look: str | None = None
    """Name of the array of which it is seen whether it is 0 everywhere; None at the end."""
    ways: dict[bool, Part] = field(default_factory=dict)
    """Behind the look."""
    results: tuple[str, ...] = ()
    """At the end."""

    def write(self, indent: str = " ") -> tuple[list[str], set[str]]:
        """Return the lines of a function, and the names that they need; what nobody reads is left out."""
        lines, needed = [], set(self.results)
        if self.look is None:
            lines.append(f"{indent}return {', '.join(self.results)},")
        else:
            needed.add(self.look)
            for seen, part in self.ways.items():
                inner, below = part.write(indent + " ")
                lines += [f"{indent}if {'' if seen else 'not '}count_nonzero({self.look}):", *inner]
                needed |= below
        for step in reversed(self.steps):
            if needed.isdisjoint(step.results):
                continue
            needed = needed.difference(step.results).union(step.reads)
            lines.insert(0, indent + step.text)
        return lines, needed


class Constant(NamedTuple):
    """A number or tensor that no tick changes."""

    name: str
    value: NDArray[Any]
    tensor: Tensor | None = None
    """Kept, as another one might get its `id`."""


class TickRecorder(TorchDispatchMode):
    """Operations of torch within it, as texts. Each is tried, and has to give what torch gives.

    Attributes:
        inputs: Names of the inputs.
        parts: What was done up to each look, with what was seen then, and up to the end.

    Example:
        >>> speed = torch.tensor([1.5, 0.5])
        >>> with torch.inference_mode(), TickRecorder([speed], {}) as recorder:
        ...     slower = (speed - 1.0).clamp_min(0.0)
        >>> [step.text for step in recorder.parts[0][0].steps], recorder.name_of(slower)
        (['v0 = subtract(i0, c0)', 'v1 = maximum(c1, v0)'], 'v1')
    """

    def __init__(self, inputs: Sequence[Tensor], constants: dict[Any, Constant]) -> None:
        """Record nothing yet.

        Args:
            inputs: Tensors, as many rows each.
            constants: Takes what is found beside them.
        """
        super().__init__()  # type: ignore[no-untyped-call]
        self.inputs = [f"i{place}" for place in range(len(inputs))]
        self.parts: list[tuple[Part, bool]] = [(Part(), False)]
        self._rows, self._constants, self._numbers = len(inputs[0]), constants, itertools.count()
        self._names = dict(zip(map(id, inputs), self.inputs, strict=True))
        """By the `id` of a tensor."""
        self._counted: dict[int, str | None] = {}
        """Of tensors that only say whether another is 0 everywhere, the name of that other."""
        self._seen: set[str] = set()
        """Names of arrays that were looked at."""
        self._own: set[str] = set()
        """Names of arrays with memory that nothing else is in."""
        self._texts: dict[str, tuple[str, ...]] = {}
        """Names of what was computed by them."""
        self._copies: dict[Any, str] = {}
        """Names of what was copied to a place of memory."""
        self._values: dict[str, Any] = dict(zip(self.inputs, (each.numpy() for each in inputs), strict=True))
        self._kept: list[Any] = [inputs]
        """Else the `id` of one might be that of another later."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Return False: nothing is compiled here, and to import what torch compiles with takes seconds."""
        return False

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Compute, and record.

        Raises:
            ValueError: This cannot be recorded.
        """
        out, name = func(*args, **(kwargs or {})), func.overloadpacket.__name__
        self._kept.append(out)
        part = self.parts[-1][0]
        if any((kwargs or {}).values()):
            raise ValueError(f"{name} has settings")
        if name in ("any", "count_nonzero") and len(args) == 1:
            self._counted[id(out)] = self.name_of(args[0])
        elif name == "detach" or (name == "view" and not args[1]):  # the same numbers
            self._names[id(out)] = self.name_of(args[0])
        elif name == "is_nonzero" and self._counted.get(id(args[0])):
            self._look(str(self._counted[id(args[0])]), out)
        elif name == "index_put_":
            part.steps.append(self._write_in_place(args))
        else:
            part.steps += self._write(name, args, out)
        return out

    def name_of(self, tensor: Tensor) -> str:
        """Return the name of a tensor: of an input, of what was computed, or of a constant.

        Raises:
            ValueError: It is for looking only, or is a constant with as many rows as the inputs have now.
        """
        if id(tensor) in self._counted:
            raise ValueError("a count is computed with")
        if id(tensor) not in self._names and self._rows in tensor.shape:
            raise ValueError("rows that are no input's")
        return self._names.get(id(tensor)) or self._name_constant(id(tensor), tensor.numpy(), tensor)

    def _look(self, name: str, seen: bool) -> None:
        """End a part where an array is looked at for the first time."""
        if name not in self._seen:
            self._seen.add(name)
            self.parts[-1][0].look = name
            self.parts[-1:] = [(self.parts[-1][0], seen), (Part(), False)]

    def _name_constant(self, key: Any, value: Any, tensor: Tensor | None = None) -> str:
        constant = self._constants.setdefault(key, Constant(f"c{len(self._constants)}", value, tensor))
        self._values[constant.name] = constant.value
        return constant.name

    def _write_arguments(self, name: str, args: Sequence[Any]) -> tuple[str, tuple[str, ...]]:
        """Return the text of an operation, and the names that it reads."""
        like = next((each for each in args if isinstance(each, Tensor) and each.is_floating_point()), None)
        reads: list[str] = []

        def write(argument: Any) -> Any:
            if isinstance(argument, list | tuple):
                return [write(each) for each in argument]
            if isinstance(argument, Tensor):
                reads.append(self.name_of(argument))
                return reads[-1]
            if name in NUMERIC and isinstance(argument, bool | int | float) and like is not None:
                value = torch.tensor(argument, dtype=like.dtype).numpy()
                return self._name_constant((repr(argument), like.dtype), value)
            return "n" if type(argument) is int and argument == self._rows else argument

        text = write_operation(name, [write(each) for each in args])
        if text is None:
            raise ValueError(f"{name} is not known")
        return text, tuple(reads)

    def _write_in_place(self, args: Sequence[Any]) -> RecordedOperation:
        text, reads = self._write_arguments("index_put_", args)
        if reads[0] not in self._own:
            raise ValueError("something else may be part of what is written to")
        self._texts, self._seen, self._counted = {}, set(), dict.fromkeys(self._counted)  # they were before
        return RecordedOperation(reads[:1], text, reads)

    def _write(self, name: str, args: Sequence[Any], out: Any) -> list[RecordedOperation]:
        """Return an operation as a step, or nothing where it gives what there is already."""
        text, reads = self._write_arguments(name, args)
        if name == "view" and "n" not in text:
            raise ValueError("sizes may depend on values")
        several = isinstance(out, list | tuple)
        outs = tuple(out) if several else (out,)
        found = eval(text, FUNCTIONS, {**self._values, "n": self._rows})
        for one, other in zip(outs, found if several else (found,), strict=True):
            _check_same(one.numpy(), other)
        copies = [self._copies.get(_place(each)) for each in outs]
        known: Sequence[str | None] = self._texts.get(text) or copies
        results = tuple(each or f"v{next(self._numbers)}" for each in known)
        self._texts.setdefault(text, results)
        self._names |= zip(map(id, outs), results, strict=True)
        self._values |= zip(results, (each.numpy() for each in outs), strict=True)
        self._own = self._own - set(results) | (set(results).difference(known) if name in MAKING else set())
        if name not in MAKING | COPYING:  # which leave the memory of what they read alone
            self._own.difference_update(reads)
        if name == "stack":
            self._copies |= zip(map(_place, out), reads, strict=True)
        left = ", ".join(results) + "," * several
        return [RecordedOperation(results, f"{left} = {text}", reads)] if None in known else []


def _place(tensor: Tensor) -> tuple[Any, ...]:
    """Return what is the same of tensors in the same place of memory."""
    return tensor.data_ptr(), tensor.shape, tensor.stride()


def _check_same(expected: NDArray[Any], found: Any) -> None:
    """Raise a ValueError where two arrays are not the same."""
    same = isinstance(found, np.ndarray) and found.dtype == expected.dtype
    if not same or not np.array_equal(found, expected, equal_nan=expected.dtype.kind == "f"):
        raise ValueError("NumPy has another result")
