"""Compilation by numba, with machine code that is kept for the next process."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

Function = TypeVar("Function", bound=Callable[..., object])
PACKAGE = Path(__file__).parents[1]
UNUSED = 7 * 24 * 3600.0
"""Machine code that no process has loaded for so long [s] is removed."""
_IMPORT = re.compile(
    rf"^[ \t]*(?:from ({PACKAGE.name}[\w.]*) import (\([^)]*\)|[^\n]*)|import ({PACKAGE.name}[\w.]*))", re.MULTILINE
)
"""A statement, which unlike those of examples in docstrings begins its line."""
_CONFIG: Any = numba.config
_JIT: Any = numba.njit  # its option `_nrt`, memory that numba manages, is not typed


def compiled(function: Function) -> Function:
    """Compile a function when it is first called; division by zero gives inf, as in torch.

    It can make no arrays and return none: it writes into those that it is given. So numba need not count references to
    arrays, which it does by atomic operations at every slice: two thirds of the time of rollouts with a policy.

    numba looks at a function's own file alone to tell whether its kept code is out of date, not at those of the
    functions and constants that it uses. So the folder is named after all sources that the file imports, and that these
    import.

    Raises:
        ImportError: numba is switched off, and would leave the function to Python.

    Example:
        >>> from rare_envs.simulation.compiled.equations import at_least  # @compiled
        >>> at_least(1.0, 2.0), hasattr(at_least, "signatures")
        (2.0, True)
    """
    return _compile(function)


def compiled_fused(function: Function) -> Function:
    """Compile as `compiled` does; products that are added are not rounded before, where the processor can do so.

    Example:
        >>> from rare_envs.simulation.compiled.networks import tanh  # @compiled_fused
        >>> values = np.array([0.0, 0.5], dtype=np.float32)
        >>> tanh(values)
        >>> values.round(4).tolist()
        [0.0, 0.46209999918937683]
    """
    return _compile(function, fastmath={"contract"})


def _compile(function: Function, **options: Any) -> Function:
    if _CONFIG.DISABLE_JIT:
        raise ImportError("NUMBA_DISABLE_JIT is set")
    dispatcher = _JIT(error_model="numpy", _nrt=False, **options)(function)
    with _kept_in(find_cache_folder(Path(function.__code__.co_filename))) as can_be_kept:
        if can_be_kept:
            dispatcher.enable_caching()
    return cast(Function, dispatcher)


def single(*values: float) -> tuple[float, ...]:
    """Return constants in single precision. To the type checker they are floats; numba infers types by itself.

    Example:
        >>> [float(value) for value in single(0.5, 0.1)]
        [0.5, 0.10000000149011612]
    """
    return tuple(cast(float, np.float32(value)) for value in values)


def whole(*values: int) -> tuple[int, ...]:
    """Return whole numbers as constants to call compiled functions with.

    A plain one is a type of its own to numba, which would compile the function anew for each.

    Example:
        >>> whole(0, 1)
        (np.int64(0), np.int64(1))
    """
    return tuple(cast(int, np.int64(value)) for value in values)


@cache
def find_cache_folder(file: Path) -> Path | None:
    """Return the folder of the machine code of a source file, made if need be; None where none can be written.

    It is below numba's `NUMBA_CACHE_DIR` if that is set, else beside this file, else in the home folder.
    """
    asked = os.environ.get("NUMBA_CACHE_DIR")
    places = (
        [Path(asked)] if asked else [Path(__file__).parent / "__pycache__", Path("~/.cache/rare-envs").expanduser()]
    )
    for place in places:
        folder = place / f"compiled-{digest_sources(file)}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            remove_old_code(place, folder)
            return folder
    return None


def remove_old_code(place: Path, kept: Path) -> None:
    """Remove the other folders, but those that were used within a week: another process may use them.

    Args:
        place: Where the folders are.
        kept: That of these sources; it is marked as used now.
    """
    with suppress(OSError):
        os.utime(kept)
    for folder in place.glob("compiled-*"):
        with suppress(OSError):  # another process may remove it, too
            if folder != kept and time.time() - folder.stat().st_mtime > UNUSED:
                shutil.rmtree(folder)


def digest_sources(file: Path) -> str:
    """Return a digest of the sources that a source file depends on."""
    digest = hashlib.blake2b(digest_size=8)
    for path in find_sources(file):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def find_sources(file: Path) -> list[Path]:
    """Return a source file and those of this package that it imports, and that these import, in a fixed order.

    A package's `__init__` is among them if something is imported from it, and not for the modules within it.
    """
    found, to_read = {file}, [file]
    while to_read:
        new = _find_imports(to_read.pop()) - found
        found |= new
        to_read += new
    return sorted(found)


@cache
def _find_imports(file: Path) -> frozenset[Path]:
    """Return the sources of this package that a source file imports, also within its functions."""
    found = set()
    for module, names, whole in _IMPORT.findall(file.read_text(encoding="utf-8")):
        members = [_find_module(f"{module}.{name}") or _find_module(module) for name in re.findall(r"\w+", names)]
        found.update(members or [_find_module(module or whole)])
    return frozenset(path for path in found if path is not None)


def _find_module(name: str) -> Path | None:
    """Return the source of a module of this package; None where there is none of this name."""
    place = PACKAGE.parent.joinpath(*name.split("."))
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)


@contextmanager
def _kept_in(folder: Path | None) -> Iterator[bool]:
    """Let numba keep code in a folder, which its configuration alone can say; yield whether it can."""
    before = _CONFIG.CACHE_DIR
    _CONFIG.CACHE_DIR = "" if folder is None else str(folder)
    try:
        yield folder is not None
    finally:
        _CONFIG.CACHE_DIR = before
