"""Files of others: whether anybody could have written them, and their pickles opened so that they cannot run code.

A pickle names classes and functions, calls them and fills what they return. Here a name gives a class of a short list
of families, which may be referred to but is not called, or a function of this module, which checks its arguments, and
only objects of known classes are filled. What NumPy's own functions accept is not safe to pass on
(`numpy.ndarray(shape, dtype, buffer)` with a dtype of objects takes bytes of the file for addresses), so arrays are
numbers, filled with as many bytes as they have. What is made takes memory in proportion to the content.
"""

from __future__ import annotations

import importlib
import io
import math
import os
import pickle
import pkgutil
import re
import stat
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

TRUST = "if you trust where the file comes from, load it with trust=True (--trust)"
"""Advice on a file that was not opened."""
TRUST_CONSEQUENCE = "it is opened as Stable-Baselines3 does, and whatever code is in it runs"
"""Consequence of trust=True."""
TRUST_ADVICE = (
    "others may have put something else there: copy it to a folder of your own, or take away their right to write "
    f"(chmod o-w). With --trust (trust=True) it is opened nevertheless; mind that {TRUST_CONSEQUENCE}, "
    "where otherwise only what is known to be harmless is made of it"
)
"""Advice on a risk."""


def find_origin_risks(*files: Path | None) -> list[str]:
    """Return reasons not to open files; empty if there are none. Files that do not exist give none.

    A file is at risk if everybody may write to it or replace it, in its folder or one above. Where everybody may add
    files but not replace those of others (/tmp), a file of another user is at risk.
    """
    if os.name != "posix":  # others' rights are not in the mode
        return []
    risks = list[str]()
    for path in (file.resolve() for file in files if file is not None and file.exists()):
        status = path.stat()
        if status.st_mode & stat.S_IWOTH:
            risks.append(f"{str(path)!r} is writable by everybody")
        for folder in path.parents:
            mode = folder.stat().st_mode
            if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
                risks.append(f"the folder {str(folder)!r} is writable by everybody")
            elif mode & stat.S_IWOTH and folder == path.parent and status.st_uid not in (0, os.getuid()):
                risks.append(f"{str(path)!r} belongs to another user, in a folder to which everybody may add")
    return list(dict.fromkeys(risks))


class ForbiddenObject(pickle.UnpicklingError):
    """A file names a class or function that is not on the list, or holds something that it could not have."""


def require(holds: object, what: str) -> None:
    """Refuse a file unless a condition holds."""
    if not holds:
        raise ForbiddenObject(what)


def open_pickle(content: bytes) -> Any:
    """Return the object in a pickle; raise `ForbiddenObject` before anything unlisted is called."""
    return _RestrictedUnpickler(io.BytesIO(content)).load()


# --- numbers ----------------------------------------------------------------------------------------

MAX_AXES, MAX_SIZE = 8, 2**31
"""Most axes of an array, and the largest size of one."""
_NUMBERS = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248])")
"""Names of the dtypes of numbers."""
_PLAIN_DTYPE = (None, None, None, -1, -1, 0)
"""What the state of a dtype has behind its version and byte order: no fields, no shape, no alignment of its own."""


def _make_dtype(name: Any, *_: Any) -> np.dtype[Any]:
    """Return the dtype of a name, of numbers."""
    require(isinstance(name, str) and _NUMBERS.fullmatch(name), f"it holds an array of {name!r:.50}, not of numbers")
    dtype: np.dtype[Any] = np.dtype(name, copy=True)
    return dtype


def _fill_dtype(dtype: np.dtype[Any], state: Any) -> None:
    """Give a dtype its byte order."""
    plain = type(state) is tuple and len(state) >= 8 and state[1] in ("<", ">", "=", "|") and state[2:8] == _PLAIN_DTYPE
    require(plain, "it holds a dtype that is not one of numbers")
    dtype.__setstate__((3, state[1], *_PLAIN_DTYPE))  # type: ignore[attr-defined]


def _make_array(*_: Any) -> NDArray[Any]:
    """Return an array that is filled later."""
    return np.empty(0, np.uint8)


def _fill_array(array: NDArray[Any], state: Any) -> None:
    """Fill an empty array with as many bytes as it has."""
    once = not array.size and array.base is None and type(state) is tuple and len(state) == 5
    require(once, "it holds an array twice")
    _, shape, dtype, fortran, content = state
    filled = _fits(shape, dtype, content) and isinstance(content, bytes) and isinstance(fortran, int)
    require(filled, "it holds an array that its bytes do not fill")
    array.__setstate__((1, shape, dtype, bool(fortran), content))  # type: ignore[arg-type]  # as pickles have it


def _read_buffer(content: Any, dtype: Any, shape: Any, order: Any = "C", axes: Any = None) -> NDArray[Any]:
    whole = _fits(shape, dtype, content) and order in ("C", "F") and axes is None
    require(whole, "it holds an array that its bytes do not fill")
    return np.frombuffer(bytearray(content), dtype=dtype).reshape(shape, order=order)


def _make_scalar(dtype: Any, content: Any = None) -> Any:
    """Return the number in some bytes."""
    require(_fits((), dtype, content), "it holds a strange number")
    return np.frombuffer(content, dtype=dtype)[0]


def _fits(shape: Any, dtype: Any, content: Any) -> bool:
    """Return whether content fills an array of numbers of a shape."""
    if not isinstance(dtype, np.dtype) or dtype.kind not in "biuf" or dtype.itemsize > 8:
        return False
    if type(shape) is not tuple or len(shape) > MAX_AXES or not isinstance(content, bytes | bytearray):
        return False
    sizes = all(type(size) is int and 0 <= size < MAX_SIZE for size in shape)
    return sizes and len(content) == math.prod(shape) * dtype.itemsize


def _is_key(value: object) -> bool:
    """Return whether a value is a text, a number, or a short tuple of such, which are quick to hash."""
    plain = str | bytes | int | float | None
    short = type(value) is tuple and len(value) <= MAX_AXES and all(isinstance(one, plain) for one in value)
    return isinstance(value, plain) or short


def _make_ordered(items: Any = ()) -> OrderedDict[Any, Any]:
    """Return a mapping of pairs."""
    pairs = isinstance(items, list | tuple) and all(isinstance(one, list | tuple) and len(one) == 2 for one in items)
    require(pairs and all(_is_key(key) for key, _ in items), "it has keys that are no text or numbers")
    return OrderedDict((key, value) for key, value in items)


def _leave_out(*_: Any) -> None:
    """Stand for a random generator: a space without one makes its own."""


def _refuse_call(*_: Any) -> None:
    raise ForbiddenObject("it makes an array over memory that it names")


CALLED: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _make_dtype,
    "numpy.ndarray": _refuse_call,
    "numpy._core.numeric._frombuffer": _read_buffer,
    "numpy._core.multiarray._reconstruct": _make_array,
    "numpy._core.multiarray.scalar": _make_scalar,
    "numpy.random._pickle.__generator_ctor": _leave_out,
    "numpy.random._pickle.__bit_generator_ctor": _leave_out,
    "numpy.random._pickle.__randomstate_ctor": _leave_out,
    "numpy.random.bit_generator.__pyx_unpickle_SeedSequence": _leave_out,
    "numpy.random.bit_generator.SeedSequence": _leave_out,
    "numpy.random._pcg64.PCG64": _leave_out,
    "numpy.random._mt19937.MT19937": _leave_out,
    "collections.OrderedDict": _make_ordered,
}
"""Names in a pickle to the functions that they stand for."""


# --- objects ----------------------------------------------------------------------------------------

REFERRED_BASES = {
    "torch.nn": ("torch.nn.Module",),
    "torch.optim": ("torch.optim.Optimizer",),
    "stable_baselines3": ("torch.nn.Module", "torch.optim.Optimizer"),
    "sb3_contrib": ("torch.nn.Module", "torch.optim.Optimizer"),
}
"""Package to the classes whose subclasses in it may be referred to."""
MADE_BASES = {
    "gymnasium.spaces": ("gymnasium.spaces.Space",),
    "stable_baselines3": (
        "stable_baselines3.common.running_mean_std.RunningMeanStd",
        "stable_baselines3.common.vec_env.VecNormalize",
    ),
}
"""Likewise, whose instances may be made, empty, and filled."""

_PythonUnpickler: Any = getattr(pickle, "_Unpickler")  # noqa: B009  (in Python, not in C; unknown to type checkers)
_HASHED = {
    pickle.SETITEM: slice(-2, -1),
    pickle.SETITEMS: slice(None, None, 2),
    pickle.DICT: slice(None, None, 2),
    pickle.ADDITEMS: slice(None),
    pickle.FROZENSET: slice(None),
}
"""Steps that hash a part of the stack, which is checked first: some keys take ages to hash."""
_REFUSED = (pickle.NEWOBJ_EX, pickle.INST, pickle.OBJ, pickle.NEXT_BUFFER, pickle.EXT1, pickle.EXT2, pickle.EXT4)
"""Steps that no saved model needs."""


def _check_keys(load: Callable[..., None], keys: slice) -> Callable[..., None]:
    """Return a step whose keys, a part of the stack, are checked first."""

    def load_checked(self: Any) -> None:
        require(all(map(_is_key, self.stack[keys])), "it has keys that are no text or numbers")
        load(self)

    return load_checked


class _RestrictedUnpickler(_PythonUnpickler):  # type: ignore[misc]
    """Unpickler that takes listed steps only."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the function or the class that a name stands for."""
        module = re.sub(r"^numpy\.core\.", "numpy._core.", module)  # what NumPy 1 called it
        if f"{module}.{name}" in CALLED:
            return CALLED[f"{module}.{name}"]
        for package, bases in (*REFERRED_BASES.items(), *MADE_BASES.items()):
            if "." not in name and f"{module}.".startswith(f"{package}."):
                named = getattr(importlib.import_module(module), name, None)  # pickles name what they need
                if _is_subclass(named, bases):
                    return named
        raise ForbiddenObject(f"it asks for {module}.{name}, which may run code")

    def load_reduce(self) -> None:
        """REDUCE: call a function."""
        arguments, function = self.stack.pop(), self.stack[-1]
        known = any(function is each for each in CALLED.values())
        require(known, f"it calls {getattr(function, '__qualname__', type(function).__name__)}, which may run code")
        self.stack[-1] = function(*arguments)

    def load_newobj(self) -> None:
        """NEWOBJ: make an empty object."""
        arguments, cls = self.stack.pop(), self.stack[-1]
        if arguments == () and any(_is_subclass(cls, bases) for bases in MADE_BASES.values()):
            self.stack[-1] = cls.__new__(cls)
        else:
            self.stack.append(arguments)
            self.load_reduce()

    def load_build(self) -> None:
        """BUILD: fill an object that was made empty."""
        state, value = self.stack.pop(), self.stack[-1]
        if isinstance(value, np.ndarray):
            _fill_array(value, state)
        elif isinstance(value, np.dtype):
            _fill_dtype(value, state)
        elif value is not None:  # which was left out
            made = tuple(base for bases in MADE_BASES.values() for base in bases)
            named = isinstance(state, dict) and all(isinstance(name, str) for name in state)
            require(_is_subclass(type(value), made) and named, f"it holds contents of {type(value).__name__}")
            getattr(value, "__setstate__", value.__dict__.update)(state)  # in Python, and keeps what it is given

    def load_refused(self) -> None:
        """Refuse what no saved model needs."""
        raise ForbiddenObject("it takes a step that no saved model needs")

    dispatch: ClassVar[dict[int, Callable[..., None]]] = {
        **_PythonUnpickler.dispatch,
        **{step[0]: _check_keys(_PythonUnpickler.dispatch[step[0]], keys) for step, keys in _HASHED.items()},
        **dict.fromkeys((step[0] for step in _REFUSED), load_refused),
        pickle.REDUCE[0]: load_reduce,
        pickle.NEWOBJ[0]: load_newobj,
        pickle.BUILD[0]: load_build,
    }


def _is_subclass(value: Any, bases: tuple[str, ...]) -> bool:
    """Return whether a value is a class below one of some classes, which are imported when needed."""
    return isinstance(value, type) and issubclass(value, tuple(map(pkgutil.resolve_name, bases)))
