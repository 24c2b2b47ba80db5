"""Values that a restricted pickle may hold: each is made and filled by a function that checks its arguments.

What NumPy's own functions accept is not safe to pass on: `numpy.ndarray(shape, dtype, buffer)` with a dtype of objects
takes bytes of the file for addresses. So arrays are numbers, filled with as many bytes as they have.
"""

from __future__ import annotations

import math
import pickle
import re
from collections import OrderedDict
from collections.abc import Callable
from enum import Enum
from typing import Any

import numpy as np
from numpy.random import MT19937, PCG64, Generator, RandomState, SeedSequence
from numpy.typing import NDArray

MAX_AXES, MAX_SIZE = 8, 2**31
"""Most axes of an array, and the largest size of one."""
_NUMBERS = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248])")
"""Names of the dtypes of numbers."""
_DTYPE_STATE = (None, None, None, -1, -1, 0)
"""What a dtype of numbers has behind its version and byte order: no fields, no shape, no alignment of its own."""


class ForbiddenObject(pickle.UnpicklingError):
    """A pickle names a class or function that is not on the list, or passes it something that it does not take.

    Example:
        >>> from agents.sb3.safe_pickle import open_pickle
        >>> try:
        ...     open_pickle(pickle.dumps(pickle.Pickler))
        ... except ForbiddenObject as error:
        ...     print(error)
        it asks for _pickle.Pickler, which may run code
    """


def is_key(value: object) -> bool:
    """Return whether a value may be a key: a text, a number, or a short tuple of such, which are quick to hash."""
    plain = str | bytes | int | float | Enum | None
    return isinstance(value, plain) or (
        type(value) is tuple and len(value) <= MAX_AXES and all(isinstance(one, plain) for one in value)
    )


def is_array_shape(value: object) -> bool:
    """Return whether a value is the shape of an array."""
    if type(value) is not tuple or len(value) > MAX_AXES:
        return False
    return all(type(size) is int and 0 <= size < MAX_SIZE for size in value)


def _require(holds: object, what: str) -> None:
    if not holds:
        raise ForbiddenObject(f"it holds {what}")


# --- arrays ---------------------------------------------------------------------------------------


def _make_dtype(name: Any, *_: Any) -> np.dtype[Any]:
    _require(isinstance(name, str) and _NUMBERS.fullmatch(name), f"an array of {name!r:.50}, not of numbers")
    dtype: np.dtype[Any] = np.dtype(name, copy=True)
    return dtype


def _fill_dtype(dtype: np.dtype[Any], state: Any) -> None:
    _require(
        type(state) is tuple and len(state) >= 8 and state[1] in ("<", ">", "=", "|") and state[2:8] == _DTYPE_STATE,
        "a dtype that is not one of numbers",
    )
    dtype.__setstate__((3, state[1], *_DTYPE_STATE))  # type: ignore[attr-defined]


def _is_numbers(dtype: Any) -> bool:
    return isinstance(dtype, np.dtype) and dtype.kind in "biuf" and dtype.fields is None and dtype.itemsize <= 8


def _make_array(*_: Any) -> NDArray[Any]:
    return np.empty(0, np.uint8)


def _fill_array(array: NDArray[Any], state: Any) -> None:
    _require(not array.size and array.base is None and type(state) is tuple and len(state) == 5, "an array twice")
    _, shape, dtype, fortran, content = state
    _require(_is_numbers(dtype) and is_array_shape(shape), "an array that is not one of numbers")
    filled = isinstance(content, bytes) and len(content) == math.prod(shape) * dtype.itemsize
    _require(filled and isinstance(fortran, int), "an array that its bytes do not fill")
    array.__setstate__((1, shape, dtype, bool(fortran), content))  # type: ignore[arg-type]  # as pickles have it


def _read_buffer(content: Any, dtype: Any, shape: Any, order: Any = "C", axes: Any = None) -> NDArray[Any]:
    _require(_is_numbers(dtype) and is_array_shape(shape) and order in ("C", "F") and axes is None, "a strange array")
    filled = isinstance(content, bytes | bytearray) and len(content) == math.prod(shape) * dtype.itemsize
    _require(filled, "an array that its bytes do not fill")
    return np.frombuffer(bytearray(content), dtype=dtype).reshape(shape, order=order)


def _make_scalar(dtype: Any, content: Any = None) -> Any:
    _require(_is_numbers(dtype) and isinstance(content, bytes) and len(content) == dtype.itemsize, "a strange number")
    return np.frombuffer(content, dtype=dtype)[0]


# --- random generators ------------------------------------------------------------------------------


def _make_bits(name: Any = "MT19937", *_: Any) -> PCG64 | MT19937:
    """Return a generator of random bits; a pickle names its class by a reconstruction or by text."""
    return PCG64(0) if "PCG64" in str(getattr(name, "name", name)) else MT19937(0)


def _fill_bits(bits: PCG64 | MT19937, state: Any) -> None:
    state = state[0] if isinstance(state, tuple) and state else state
    _require(isinstance(state, dict), "a random generator without its state")
    if isinstance(bits, MT19937):
        _check_twister(state)
    bits.state = state


def _check_twister(state: dict[str, Any]) -> None:
    """Refuse a state of MT19937 whose position is outside of its key, which NumPy would follow."""
    inner = state.get("state")
    if not isinstance(inner, dict):
        inner = {}
    key, position = inner.get("key"), inner.get("pos")
    whole = isinstance(key, np.ndarray) and key.shape == (624,) and type(position) is int and 0 <= position <= 624
    _require(whole, "a random generator in no state of its own")


def _fill_random_state(generator: RandomState, state: Any) -> None:
    _require(isinstance(state, dict), "a random generator without its state")
    _check_twister(state)
    generator.set_state(state)


def _make_generator(bits: Any = None, *_: Any) -> Generator:
    return Generator(bits if isinstance(bits, PCG64 | MT19937) else _make_bits(bits))


def _make_random_state(bits: Any = None, *_: Any) -> RandomState:
    return RandomState(bits if isinstance(bits, MT19937) else MT19937(0))


def _make_seed_sequence(*_: Any) -> SeedSequence:
    return SeedSequence(0)


def _fill_generator(generator: Generator, state: Any) -> None:
    _require(isinstance(state, dict), "a random generator without its state")
    _fill_bits(generator.bit_generator, state)  # type: ignore[arg-type]  # made above, with one of these


# --- builtins ---------------------------------------------------------------------------------------


def _make_ordered(items: Any = ()) -> OrderedDict[Any, Any]:
    pairs = isinstance(items, list | tuple) and all(isinstance(one, list | tuple) and len(one) == 2 for one in items)
    _require(pairs and all(is_key(key) for key, _ in items), "a mapping with strange keys")
    return OrderedDict((key, value) for key, value in items)


def _make_set(items: Any = ()) -> set[Any]:
    _require(isinstance(items, list | tuple) and all(map(is_key, items)), "a set of strange things")
    return set(items)


def _make_frozenset(items: Any = ()) -> frozenset[Any]:
    return frozenset(_make_set(items))


def _make_bytearray(content: Any = b"") -> bytearray:
    _require(isinstance(content, bytes), "bytes by their number")  # bytearray(n) takes n bytes of memory
    return bytearray(content)


def _refuse_call(*_: Any) -> None:
    raise ForbiddenObject("it makes an array over memory that it names")


def _find_member(cls: Any, name: Any) -> Any:
    """Return a member of an enumeration: Python 3.11.0 to 3.11.3 pickles one as an attribute of its class."""
    known = isinstance(cls, type) and issubclass(cls, Enum) and isinstance(name, str) and name in cls.__members__
    _require(known, "an attribute of what is no enumeration")
    return cls.__members__[name]


RECONSTRUCTIONS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _make_dtype,
    "numpy.ndarray": _refuse_call,
    "numpy._core.numeric._frombuffer": _read_buffer,
    "numpy._core.multiarray._reconstruct": _make_array,
    "numpy._core.multiarray.scalar": _make_scalar,
    "numpy.random._pickle.__generator_ctor": _make_generator,
    "numpy.random._pickle.__bit_generator_ctor": _make_bits,
    "numpy.random._pickle.__randomstate_ctor": _make_random_state,
    "numpy.random.bit_generator.__pyx_unpickle_SeedSequence": _make_seed_sequence,
    "numpy.random.bit_generator.SeedSequence": _make_seed_sequence,
    "numpy.random._pcg64.PCG64": _make_bits,
    "numpy.random._mt19937.MT19937": _make_bits,
    "collections.OrderedDict": _make_ordered,
    "builtins.set": _make_set,
    "builtins.frozenset": _make_frozenset,
    "builtins.bytearray": _make_bytearray,
    "builtins.complex": complex,
    "builtins.getattr": _find_member,
}
"""Names in a pickle to the functions that they stand for."""


def fill_value(value: Any, state: Any) -> None:
    """Fill an object that was made empty.

    Raises:
        ForbiddenObject: It is of another kind, or the state is none of its own.
    """
    for kind, fill in _FILLS.items():
        if isinstance(value, kind):
            fill(value, state)
            return
    from gymnasium.spaces import Space
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.vec_env import VecNormalize

    _require(isinstance(value, Space | RunningMeanStd | VecNormalize), f"contents of {type(value).__name__}")
    _require(isinstance(state, dict) and all(isinstance(name, str) for name in state), "contents without names")
    setstate = getattr(value, "__setstate__", value.__dict__.update)  # written in Python, and keep what they are given
    setstate(state)


def _fill_ordered(value: OrderedDict[Any, Any], state: Any) -> None:
    """Keep what torch writes beside a state dict, versions of its modules; nothing else."""
    metadata = state.get("_metadata") if isinstance(state, dict) else None
    if isinstance(metadata, dict):
        value._metadata = metadata  # type: ignore[attr-defined]


_FILLS: dict[Any, Callable[[Any, Any], None]] = {
    np.ndarray: _fill_array,
    np.dtype: _fill_dtype,
    PCG64 | MT19937: _fill_bits,
    Generator: _fill_generator,
    RandomState: _fill_random_state,
    SeedSequence: lambda sequence, state: None,
    OrderedDict: _fill_ordered,
}
"""Classes of objects to what fills them."""
