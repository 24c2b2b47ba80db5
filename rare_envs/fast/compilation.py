"""Compilation by numba of functions that make no arrays. Importing this module needs numba."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

Function = TypeVar("Function", bound=Callable[..., object])
PACKAGE = Path(__file__).parents[1]
COMPILED_IN = ("fast", "control", "measures", "scenarios", "simulation", "traffic")
"""Folders with functions and constants that are compiled."""
UNUSED = 7 * 24 * 3600.0
"""Machine code that no process has used for so long [s] is removed."""
_CONFIG: Any = numba.config
_JIT: Any = numba.njit  # its option `_nrt`, memory that numba manages, is not typed


def compiled(function: Function, **options: Any) -> Function:
    """Compile a function when it is first called; division by zero gives inf, as in torch.

    It can make no arrays and return none: it writes into those that it is given. So numba need not count references to
    arrays, which it does by atomic operations at every slice: two thirds of the time of rollouts with a policy.

    Raises:
        ImportError: numba is switched off, and would leave the function to Python.
    """
    if _CONFIG.DISABLE_JIT:
        raise ImportError("NUMBA_DISABLE_JIT is set")
    before, _CONFIG.CACHE_DIR = _CONFIG.CACHE_DIR, _CACHE
    try:
        return cast(Function, _JIT(cache=True, error_model="numpy", _nrt=False, **options)(function))
    finally:
        _CONFIG.CACHE_DIR = before


def inlined(function: Function) -> Function:
    """Compile as `compiled` does, into its callers: `Rows` are many numbers to hand over."""
    return compiled(function, inline="always")


def compiled_fused(function: Function) -> Function:
    """Compile as `compiled` does; products that are added are not rounded before, where the processor can do so."""
    return compiled(function, fastmath={"contract"})


def single(*values: float) -> tuple[float, ...]:
    """Return constants in single precision. To the type checker they are floats; numba infers types by itself."""
    return tuple(cast(float, np.float32(value)) for value in values)


def find_cache() -> str:
    """Return the folder of machine code of the sources as they are, below `NUMBA_CACHE_DIR` or beside this file.

    numba looks at a function's own file alone to tell whether its kept code is out of date, not at those of the
    functions and constants that it uses. Folders of other sources are removed when nobody has used them for long.
    """
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(path for name in COMPILED_IN for path in (PACKAGE / name).glob("*.py")):
        at = path.stat()
        digest.update(f"{path} {at.st_mtime_ns} {at.st_size}".encode())
    place = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent / "__pycache__")
    folder = place / f"compiled-{digest.hexdigest()}"
    for other in place.glob("compiled-*"):
        if time.time() - other.stat().st_mtime > UNUSED:
            shutil.rmtree(other, ignore_errors=True)
    return str(folder)


_CACHE = find_cache()
