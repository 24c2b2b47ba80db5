"""Restricted unpickling: only classes and functions of a short list are called, so a pickle cannot run code.

A pickle names the classes and functions that it wants to call. The list holds spaces, networks, optimisers and
statistics of Gymnasium, PyTorch and Stable-Baselines3, and what NumPy rebuilds its arrays with.
"""

from __future__ import annotations

import importlib
import io
import pickle
import re
from typing import Any

ALLOWED_NAMES = {
    "numpy": {"dtype", "ndarray"},
    "numpy._core.numeric": {"_frombuffer"},
    "numpy._core.multiarray": {"scalar", "_reconstruct"},
    "numpy.random._pickle": {"__generator_ctor", "__bit_generator_ctor", "__randomstate_ctor"},
    "numpy.random.bit_generator": {"__pyx_unpickle_SeedSequence", "SeedSequence"},
    "numpy.random._pcg64": {"PCG64"},
    "numpy.random._mt19937": {"MT19937"},
    "collections": {"OrderedDict"},
    "builtins": {"set", "frozenset", "slice", "bytearray", "complex", "object"},
    "copyreg": {"_reconstructor"},
}
"""Module to names that are harmless to call."""
ALLOWED_BASES = {
    "gymnasium.spaces": ("gymnasium.spaces.Space",),
    "torch.nn": ("torch.nn.Module",),
    "torch.optim": ("torch.optim.Optimizer",),
    "stable_baselines3": (
        "torch.nn.Module",
        "torch.optim.Optimizer",
        "stable_baselines3.common.type_aliases.TrainFreq",
        "stable_baselines3.common.type_aliases.TrainFrequencyUnit",
        "stable_baselines3.common.running_mean_std.RunningMeanStd",
        "stable_baselines3.common.vec_env.VecNormalize",
    ),
    "sb3_contrib": ("torch.nn.Module", "torch.optim.Optimizer"),
}
"""Package to the classes whose subclasses in it may be made."""


class ForbiddenObject(pickle.UnpicklingError):
    """A pickle names a class or function that is not on the list.

    Example:
        >>> try:
        ...     open_pickle(pickle.dumps(pickle.Pickler))
        ... except ForbiddenObject as error:
        ...     print(error)
        it asks for _pickle.Pickler, which may run code
    """


class _RestrictedUnpickler(pickle.Unpickler):
    """Unpickler that finds listed classes and functions only."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the class or function of that name, if it is listed."""
        if "." not in name:
            module = re.sub(r"^numpy\.core\.", "numpy._core.", module)  # what NumPy 1 called it
            if name in ALLOWED_NAMES.get(module, ()):
                return getattr(importlib.import_module(module), name)  # pickles name what they need
            for package, bases in ALLOWED_BASES.items():
                if module == package or module.startswith(f"{package}."):
                    named = getattr(importlib.import_module(module), name, None)  # likewise
                    if isinstance(named, type) and issubclass(named, tuple(map(_import_class, bases))):
                        return named
        raise ForbiddenObject(f"it asks for {module}.{name}, which may run code")


def _import_class(path: str) -> type:
    """Import `module.Class`."""
    module, _, name = path.rpartition(".")
    imported: type = getattr(importlib.import_module(module), name)  # of ALLOWED_BASES, imported when needed
    return imported


def open_pickle(content: bytes) -> Any:
    """Return the object in a pickle.

    Raises:
        ForbiddenObject: It names a class or function that is not listed; nothing has been called then.
        Exception: The pickle is damaged; anything may be raised.

    Example:
        >>> import fractions
        >>> open_pickle(pickle.dumps({"gamma": 0.98}))
        {'gamma': 0.98}
        >>> open_pickle(pickle.dumps(fractions.Fraction(1, 2)))
        Traceback (most recent call last):
        ...
        agents.sb3.safe_pickle.ForbiddenObject: it asks for fractions.Fraction, which may run code
    """
    return _RestrictedUnpickler(io.BytesIO(content)).load()
