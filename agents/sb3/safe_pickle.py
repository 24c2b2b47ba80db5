"""Pickles opened without running what their author may have put there.

A pickle names the classes and functions that it wants to call. Here it gets those of a short list: spaces, networks,
optimisers and statistics of Gymnasium, PyTorch and Stable-Baselines3, and what NumPy rebuilds its arrays with.
"""

from __future__ import annotations

import importlib
import io
import pickle
import re
from typing import Any

ARRAYS = {
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
"""Module to names of what is harmless to call."""
CLASSES = {
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


class ForeignObject(pickle.UnpicklingError):
    """A pickle asks for something that is not on the list."""


class _Reader(pickle.Unpickler):
    """Finds listed classes and functions only."""

    def find_class(self, module: str, name: str) -> Any:
        """The class or function of that name, if it is listed."""
        if "." not in name:
            module = re.sub(r"^numpy\.core\.", "numpy._core.", module)  # what NumPy 1 called it
            if name in ARRAYS.get(module, ()):
                return getattr(importlib.import_module(module), name)
            for package, bases in CLASSES.items():
                if module == package or module.startswith(f"{package}."):
                    found = getattr(importlib.import_module(module), name, None)
                    if isinstance(found, type) and issubclass(found, tuple(map(_import_class, bases))):
                        return found
        raise ForeignObject(f"it asks for {module}.{name}, which may run code")


def _import_class(path: str) -> type:
    module, _, name = path.rpartition(".")
    found: type = getattr(importlib.import_module(module), name)
    return found


def open_pickle(content: bytes) -> Any:
    """The object in a pickle.

    Raises:
        ForeignObject: It asks for a class or function that is not listed; nothing of it has been called.
        Exception: The pickle is damaged; anything may be raised.
    """
    return _Reader(io.BytesIO(content)).load()
