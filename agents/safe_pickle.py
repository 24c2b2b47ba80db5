"""Files of others: whether anybody could have written them, and their pickles opened so that they cannot run code.

A pickle names classes and functions, calls them and fills what they return. Here it is first read into a tree of inert
notes of what it wants; then each is made if its name is on a short list, from arguments that are checked. What NumPy's
own functions accept is not safe to pass on (`numpy.ndarray(shape, dtype, buffer)` with a dtype of objects takes bytes
of the file for addresses), so arrays are numbers, of as many bytes as they have. What is made takes memory in
proportion to the content.
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

from rare_envs.plugins import import_module

TRUST = "if you trust where the file comes from, load it with trust=True (--trust)"
"""Advice on a file that was not opened."""
TRUST_CONSEQUENCE = "it is opened as Stable-Baselines3 does, and any code in it runs"
"""Consequence of trust=True."""
TRUST_ADVICE = (
    "others may have put something else there: copy it to a folder of your own, or take away their right to write "
    f"(chmod o-w). --trust (trust=True) opens it all the same: {TRUST_CONSEQUENCE}"
)
"""Advice on a risk."""


def find_origin_risks(*files: Path | None) -> list[str]:
    """Return reasons not to open files; empty if there are none. Files that do not exist give none.

    A file is at risk if everybody may write to it or replace it, in its folder or one above. If everybody may add
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


def open_pickle(content: bytes, trust: bool = False) -> Any:
    """Return the object in a pickle; raise `ForbiddenObject` where it needs anything unlisted, but for trust."""
    if trust:
        return _RenamingUnpickler(io.BytesIO(content)).load()
    return make(read_notes(content))


_RENAMED = {"gym.spaces": "gymnasium.spaces", "numpy.core": "numpy._core"}
"""Packages to what they are called since Stable-Baselines3 2 and NumPy 2."""
_GENERATORS = ("numpy.random.", "gym.utils.seeding.")
"""Where random generators are: a space without one makes its own."""


def _rename(name: str) -> str:
    """Return the present name of what a pickle names."""
    for old, new in _RENAMED.items():
        if f"{name}.".startswith(f"{old}."):
            return new + name.removeprefix(old)
    return name


class _RenamingUnpickler(pickle.Unpickler):
    """Python's own, which runs whatever code is named, with present names."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what a name stands for; a new generator for one of Gym's."""
        if module.startswith(_GENERATORS[1][:-1]):
            return lambda *_: np.random.default_rng()
        import_module(_rename(module), "a file of an ego")  # of the working directory too
        return super().find_class(_rename(module), name)


# --- reading ----------------------------------------------------------------------------------------

MAX_AXES, MAX_SIZE = 8, 2**31
"""Most axes of an array, and the largest size of one."""
MAX_STEPS = 100_000
"""Instructions of a pickle, each of which may make an object; that of a policy has some thousand."""


class Note:
    """What a pickle names; an instance is what it wants made of that: from arguments, a state, and entries put in."""

    name: ClassVar[str]

    def __new__(cls, *arguments: Any) -> Note:
        """Return a note of what a class or function is to make of arguments."""
        note = super().__new__(cls)
        note.arguments, note.state, note.entries = arguments, None, dict[Any, Any]()
        return note

    arguments: tuple[Any, ...]
    state: Any
    entries: dict[Any, Any]

    def __call__(self, *arguments: Any) -> Note:
        """Return a note of what it wants called, which is on no list."""
        called: type[Note] = type("Note", (Note,), {"name": f"{self.name}()"})
        return called(*arguments)

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __setitem__(self, key: Any, value: Any) -> None:
        self.entries[key] = value


def _is_key(value: object) -> bool:
    """Return whether a value is a text, a number, or a short tuple of such, which are quick to hash."""
    plain = str | bytes | int | float | None
    short = type(value) is tuple and len(value) <= MAX_AXES and all(isinstance(one, plain) for one in value)
    return isinstance(value, plain) or short


_PythonUnpickler: Any = getattr(pickle, "_Unpickler")  # noqa: B009  (in Python, not in C; unknown to type checkers)


_KEYS = {
    pickle.SETITEM[0]: slice(-2, -1),
    **dict.fromkeys((pickle.SETITEMS[0], pickle.DICT[0]), slice(None, None, 2)),
    **dict.fromkeys((pickle.ADDITEMS[0], pickle.FROZENSET[0]), slice(None)),
}
"""Parts of the stack that are keys, by instruction."""


def _check(code: int, step: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return an instruction that is counted, and whose keys are checked first."""

    def load(self: Any) -> None:
        self.steps += 1
        require(self.steps <= MAX_STEPS, f"it has more than {MAX_STEPS:,} instructions")
        keys = self.stack[_KEYS[code]] if code in _KEYS else ()
        require(all(map(_is_key, keys)), "it has keys that are no text or numbers")
        step(self)

    return load


class _InertUnpickler(_PythonUnpickler):  # type: ignore[misc]
    """Unpickler that makes notes in place of objects, and hashes nothing that takes ages to hash."""

    dispatch: ClassVar[dict[int, Callable[[Any], None]]] = {
        code: _check(code, step) for code, step in _PythonUnpickler.dispatch.items()
    }
    steps = 0

    def find_class(self, module: str, name: str) -> type[Note]:
        """Return a kind of note for a name."""
        return type("Note", (Note,), {"name": f"{module}.{name}"})


def read_notes(content: bytes) -> Any:
    """Return what a pickle holds, with a `Note` in place of each object that is to be made."""
    return _InertUnpickler(io.BytesIO(content)).load()


# --- making -----------------------------------------------------------------------------------------

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
_NUMBERS = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248])")
"""Names of the dtypes of numbers."""


def make(notes: Any) -> Any:
    """Return what notes want; raise `ForbiddenObject` where that is anything unlisted."""
    return _Maker().make(notes)


class _Maker:
    """Makes what notes want, each once."""

    def __init__(self) -> None:
        self.made = dict[int, Any]()
        self.special: dict[str, Callable[[Note], Any]] = {
            "numpy.dtype": self.make_dtype,
            "numpy._core.numeric._frombuffer": lambda note: self.fill(*note.arguments),
            "numpy._core.multiarray._reconstruct": lambda note: self.make_array(note.state),
            "jax._src.array._reconstruct_array": lambda note: self.make_array(note.arguments[2]),
            "numpy._core.multiarray.scalar": lambda note: self.fill(note.arguments[1], note.arguments[0], ())[()],
            "collections.OrderedDict": self.make_ordered,
        }

    def make(self, value: Any) -> Any:
        """Return a value with everything in it made."""
        if id(value) not in self.made:
            self.made[id(value)] = self._make(value)
        return self.made[id(value)]

    def _make(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {key: self.make(one) for key, one in value.items()}
        if type(value) in (list, tuple):
            return type(value)(map(self.make, value))
        if isinstance(value, type) and issubclass(value, Note):
            return _find_class(value.name, REFERRED_BASES)
        if not isinstance(value, Note):
            return value
        name = _rename(value.name)
        if name.startswith(_GENERATORS):
            return None
        return self.special[name](value) if name in self.special else self.make_object(value)

    def make_object(self, note: Note) -> Any:
        """Return an object that was made empty and filled."""
        cls, state = _find_class(_rename(note.name), MADE_BASES), self.make(note.state)
        require(not note.arguments, f"it calls {note.name}, which may run code")
        named = isinstance(state, dict) and all(isinstance(name, str) for name in state)
        require(named, f"it holds contents of {cls.__name__}")
        value = cls.__new__(cls)
        getattr(value, "__setstate__", value.__dict__.update)(state)  # in Python, and keeps what it is given
        return value

    def make_ordered(self, note: Note) -> OrderedDict[Any, Any]:
        """Return a mapping of pairs."""
        pairs = [*(note.arguments[0] if note.arguments else ()), *note.entries.items()]
        require(all(_is_key(key) for key, _ in pairs), "it has keys that are no text or numbers")
        return OrderedDict((key, self.make(value)) for key, value in pairs)

    def make_dtype(self, note: Note) -> np.dtype[Any]:
        """Return a dtype of numbers."""
        name, *_ = note.arguments
        require(isinstance(name, str) and _NUMBERS.fullmatch(name), f"it holds an array of {name!r:.50}, not numbers")
        dtype: np.dtype[Any] = np.dtype(name)
        return dtype.newbyteorder(note.state[1]) if type(note.state) is tuple else dtype

    def make_array(self, state: Any) -> NDArray[Any]:
        """Return an array that is filled by its state."""
        require(type(state) is tuple and len(state) == 5, "it holds an array that is not filled")
        _, shape, dtype, fortran, content = state
        return self.fill(content, dtype, shape, "F" if fortran is True else "C")

    def fill(self, content: Any, kind: Any, shape: Any, order: Any = "C") -> NDArray[Any]:
        """Return an array of numbers of a shape that some bytes fill."""
        dtype = self.make(kind)
        sizes = type(shape) is tuple and len(shape) <= MAX_AXES
        sizes = sizes and all(type(size) is int and 0 <= size < MAX_SIZE for size in shape)
        fits = sizes and isinstance(dtype, np.dtype) and isinstance(content, bytes | bytearray) and order in ("C", "F")
        require(fits and len(content) == math.prod(shape) * dtype.itemsize, "it holds an array not filled by its bytes")
        return np.ndarray(shape, dtype, bytearray(content), order=order)


def _find_class(name: str, known: dict[str, tuple[str, ...]]) -> Any:
    """Return the class of a name, in one of some packages and below one of its classes."""
    module, _, attribute = name.rpartition(".")
    for package, bases in known.items():
        if f"{module}.".startswith(f"{package}."):
            found = getattr(importlib.import_module(module), attribute, None)  # pickles name what they need
            if isinstance(found, type) and issubclass(found, tuple(map(pkgutil.resolve_name, bases))):
                return found
    raise ForbiddenObject(f"it asks for {name}, which may run code")
