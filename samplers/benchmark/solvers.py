"""Methods of the benchmark by name: ours, those of other libraries, and those of a user."""

from __future__ import annotations

import hashlib
import importlib
import sys
from collections.abc import Callable, Iterable
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from samplers.benchmark.openturns_methods import OPENTURNS
from samplers.benchmark.uqpy_methods import UQPY
from samplers.method import Stepping
from samplers.registry import METHODS

Solver = Callable[..., Any]
"""Called as solver(problem, seed=..., max_sim=...); returns p, low and high, with the c.o.v. if it knows it, or an
object with `p`, `interval` and perhaps `cov`."""

OTHER_SOLVERS: dict[str, Solver] = {**OPENTURNS, **UQPY}
"""Solvers of other libraries, by names that begin with that of the library."""
NEEDED_MODULES = {"openturns": ("openturns",), "uqpy": ("UQpy", "pkg_resources")}
"""By library, which is also the name of the extra that installs them."""


def find_method(name: str) -> Stepping | Solver:
    """Return a method by its name, or by where it stands.

    Args:
        name: A name of `samplers.METHODS`, `OPENTURNS` or `UQPY`; or `module:attribute`, the attribute a class with the
            protocol of our methods (`samplers.testing.check_method` checks it) or a `Solver`.

    Raises:
        ValueError: There is no such method, or its library is not installed.

    Example:
        >>> find_method("mc").name
        'mc'
    """
    if name in OTHER_SOLVERS:
        _check_installed(name)
        return OTHER_SOLVERS[name]
    if ":" not in name:
        if name not in METHODS:
            known = ", ".join([*METHODS, *OTHER_SOLVERS])
            raise ValueError(f"Unknown method {name!r}; known: {known}, or module:attribute.")
        return METHODS[name]()
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"Cannot load the method {name}: {error}") from None
    if isinstance(found, type):
        found = found()
    if isinstance(found, Stepping):
        return found
    if not callable(found):
        raise ValueError(f"Expected {name} to be a method or a function, got {type(found).__name__}.")
    solver: Solver = found
    return solver


def find_library_versions(methods: Iterable[str]) -> dict[str, str]:
    """Return the versions of the other libraries whose methods are among some.

    Example:
        >>> find_library_versions(["mc", "adss"])
        {}
    """
    libraries = {name.partition("-")[0] for name in methods if name in OTHER_SOLVERS}
    return {name: version(NEEDED_MODULES[name][0]) for name in sorted(libraries)}


def digest_method(method: Stepping | Solver) -> str:
    """Return what tells the code of a method of somebody else from another version of it.

    Returns:
        A digest of the Python files of the package that the method is of, or of its module where it stands alone. For
        solvers of other libraries, the version of the library. Empty for our own methods, and where there is no file.

    Example:
        >>> digest_method(find_method("mc"))
        ''
    """
    for name, solver in OTHER_SOLVERS.items():
        if method is solver:
            return " ".join(find_library_versions([name]).values())
    named = method if hasattr(method, "__name__") else type(method)  # a function, else a method's class
    package = str(getattr(named, "__module__", "")).partition(".")[0]
    if package in (__name__.partition(".")[0], "builtins", "__main__", ""):
        return ""
    return _digest_package(package)


@cache
def _digest_package(package: str) -> str:
    """Return a digest of the Python files of a top-level package or module; empty if it has none."""
    module = sys.modules.get(package)
    found = find_spec(package) if module is None else module.__spec__
    if found is None:  # a module that was made by a program
        return ""
    if found.submodule_search_locations is not None:
        paths = sorted(path for folder in found.submodule_search_locations for path in Path(folder).rglob("*.py"))
    else:
        paths = [Path(found.origin)] if found.has_location and found.origin else []
    digest = hashlib.blake2b(digest_size=8)
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest() if paths else ""


def _check_installed(name: str) -> None:
    """Raise ValueError if a module that a method needs is missing."""
    library = name.partition("-")[0]
    missing = [module for module in NEEDED_MODULES[library] if find_spec(module) is None]
    if missing:
        raise ValueError(f'The method {name} needs the module {missing[0]}: pip install "rare-envs[{library}]".')
