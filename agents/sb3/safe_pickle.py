"""Restricted unpickling: only listed reconstructions happen, with checked arguments, so a pickle cannot run code.

A pickle names classes and functions, calls them and fills what they return. Here a name gives a class of a short list
of families, which may be referred to but is not called, or stands for a function of `agents.sb3.pickle_values`, which
checks its arguments; and only objects of known classes are filled. The interpreter is that of the standard library in
Python, so that each step can be checked; what it makes takes memory in proportion to the content.
"""

from __future__ import annotations

import importlib
import io
import pickle
import re
from collections import OrderedDict
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, ClassVar, NamedTuple

from agents.sb3.pickle_values import RECONSTRUCTIONS, ForbiddenObject, fill_value, is_key

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
CALLED_CLASSES = {
    "stable_baselines3": (
        "stable_baselines3.common.type_aliases.TrainFreq",
        "stable_baselines3.common.type_aliases.TrainFrequencyUnit",
    )
}
"""Likewise, whose constructors take plain values and keep them."""


class _Reconstruction(NamedTuple):
    """A name that stands for a checked function."""

    name: str
    function: Callable[..., Any]


_PythonUnpickler: Any = getattr(pickle, "_Unpickler")  # noqa: B009  (in Python, not in C; unknown to type checkers)


class RestrictedUnpickler(_PythonUnpickler):  # type: ignore[misc]
    """Unpickler that takes listed steps only."""

    dispatch: ClassVar[dict[int, Callable[..., None]]] = dict(_PythonUnpickler.dispatch)
    reconstructions: ClassVar[dict[str, Callable[..., Any]]] = RECONSTRUCTIONS
    """What names stand for."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the class, or the reconstruction, of that name.

        Raises:
            ForbiddenObject: It is not listed.
        """
        module = re.sub(r"^numpy\.core\.", "numpy._core.", module)  # what NumPy 1 called it
        if f"{module}.{name}" in self.reconstructions:
            return _Reconstruction(f"{module}.{name}", self.reconstructions[f"{module}.{name}"])
        found = None if "." in name else self.find_listed_class(module, name)
        if found is None:
            raise ForbiddenObject(f"it asks for {module}.{name}, which may run code")
        return found

    def find_listed_class(self, module: str, name: str) -> type | None:
        """Return a class of the listed families; None if it is of none."""
        for table in (REFERRED_BASES, MADE_BASES, CALLED_CLASSES):
            for package, bases in table.items():
                if module == package or module.startswith(f"{package}."):
                    named = getattr(importlib.import_module(module), name, None)  # pickles name what they need
                    if _is_subclass(named, bases):
                        return named
        return None

    def persistent_load(self, pid: Any) -> Any:
        """Refuse objects that are kept elsewhere."""
        raise ForbiddenObject("it refers to something outside of it")

    def call(self, function: Any, arguments: Any) -> Any:
        """Return what a listed function gives for arguments that it has checked."""
        if not isinstance(arguments, tuple):
            raise pickle.UnpicklingError("arguments that are no tuple")
        if isinstance(function, _Reconstruction):
            return function.function(*arguments)
        if _is_listed(function, CALLED_CLASSES) and all(isinstance(one, int | str | Enum) for one in arguments):
            return function(*arguments)
        raise ForbiddenObject(f"it calls {_name_of(function)}, which may run code")

    def make(self, cls: Any, arguments: Any, keywords: Any = None) -> Any:
        """Return a new object of a listed class, not initialised."""
        if _is_listed(cls, MADE_BASES) and arguments == () and not keywords:
            return cls.__new__(cls)
        if keywords:
            raise ForbiddenObject(f"it makes {_name_of(cls)} with keyword arguments")
        return self.call(cls, arguments)

    def load_reduce(self) -> None:
        """REDUCE: call a function."""
        arguments = self.stack.pop()
        self.stack[-1] = self.call(self.stack[-1], arguments)

    def load_newobj(self) -> None:
        """NEWOBJ: make an object."""
        arguments = self.stack.pop()
        self.stack[-1] = self.make(self.stack[-1], arguments)

    def load_newobj_ex(self) -> None:
        """NEWOBJ_EX: make an object with keyword arguments."""
        keywords, arguments = self.stack.pop(), self.stack.pop()
        self.stack[-1] = self.make(self.stack[-1], arguments, keywords)

    def load_build(self) -> None:
        """BUILD: fill an object."""
        state = self.stack.pop()
        fill_value(self.stack[-1], state)

    def load_append(self) -> None:
        """APPEND to a list."""
        value = self.stack.pop()
        _expect(self.stack[-1], list).append(value)

    def load_appends(self) -> None:
        """APPENDS to a list."""
        values = self.pop_mark()
        _expect(self.stack[-1], list).extend(values)

    def load_setitem(self) -> None:
        """SETITEM of a mapping."""
        value, key = self.stack.pop(), self.stack.pop()
        _set_items(self.stack[-1], [key, value])

    def load_setitems(self) -> None:
        """SETITEMS of a mapping."""
        items = self.pop_mark()
        _set_items(self.stack[-1], items)

    def load_dict(self) -> None:
        """DICT of the items on the stack."""
        items = self.pop_mark()
        self.append({})
        _set_items(self.stack[-1], items)

    def load_additems(self) -> None:
        """ADDITEMS to a set."""
        items = self.pop_mark()
        _expect(self.stack[-1], set).update(_checked_keys(items))

    def load_frozenset(self) -> None:
        """FROZENSET of the items on the stack."""
        items = self.pop_mark()
        self.append(frozenset(_checked_keys(items)))

    def load_refused(self) -> None:
        """Refuse what no pickle of today's needs."""
        raise ForbiddenObject("it takes a step that no saved model needs")

    def get_extension(self, code: int) -> None:
        """Refuse names by number."""
        self.load_refused()


for _opcode, _method in {
    pickle.REDUCE: RestrictedUnpickler.load_reduce,
    pickle.NEWOBJ: RestrictedUnpickler.load_newobj,
    pickle.NEWOBJ_EX: RestrictedUnpickler.load_newobj_ex,
    pickle.BUILD: RestrictedUnpickler.load_build,
    pickle.APPEND: RestrictedUnpickler.load_append,
    pickle.APPENDS: RestrictedUnpickler.load_appends,
    pickle.SETITEM: RestrictedUnpickler.load_setitem,
    pickle.SETITEMS: RestrictedUnpickler.load_setitems,
    pickle.DICT: RestrictedUnpickler.load_dict,
    pickle.ADDITEMS: RestrictedUnpickler.load_additems,
    pickle.FROZENSET: RestrictedUnpickler.load_frozenset,
    pickle.INST: RestrictedUnpickler.load_refused,
    pickle.OBJ: RestrictedUnpickler.load_refused,
    pickle.NEXT_BUFFER: RestrictedUnpickler.load_refused,
}.items():
    RestrictedUnpickler.dispatch[_opcode[0]] = _method


def _set_items(mapping: Any, items: list[Any]) -> None:
    if type(mapping) not in (dict, OrderedDict):
        raise ForbiddenObject(f"it sets items of {type(mapping).__name__}")
    mapping.update(zip(_checked_keys(items[::2]), items[1::2], strict=True))


def _checked_keys(keys: list[Any]) -> list[Any]:
    if not all(map(is_key, keys)):
        raise ForbiddenObject("it has keys that are no text or numbers")
    return keys


def _expect(value: Any, kind: type) -> Any:
    if type(value) is not kind:
        raise ForbiddenObject(f"it adds to {type(value).__name__}")
    return value


def _is_listed(value: Any, table: Mapping[str, tuple[str, ...]]) -> bool:
    return any(_is_subclass(value, bases) for bases in table.values())


def _is_subclass(value: Any, bases: tuple[str, ...]) -> bool:
    return isinstance(value, type) and issubclass(value, tuple(map(_import_class, bases)))


def _import_class(path: str) -> type:
    """Import `module.Class`."""
    module, _, name = path.rpartition(".")
    imported: type = getattr(importlib.import_module(module), name)  # of the tables, imported when needed
    return imported


def _name_of(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}" if isinstance(value, type) else type(value).__name__


def open_pickle(content: bytes) -> Any:
    """Return the object in a pickle.

    Raises:
        ForbiddenObject: It names a class or function that is not listed, or takes another step that is not; nothing has
            been called then.
        Exception: The pickle is damaged; anything may be raised.

    Example:
        >>> import fractions
        >>> open_pickle(pickle.dumps({"gamma": 0.98}))
        {'gamma': 0.98}
        >>> open_pickle(pickle.dumps(fractions.Fraction(1, 2)))
        Traceback (most recent call last):
        ...
        agents.sb3.pickle_values.ForbiddenObject: it asks for fractions.Fraction, which may run code
    """
    return RestrictedUnpickler(io.BytesIO(content)).load()
