"""The examples in docstrings print what they show, and everything public has one."""

import doctest
import importlib
import importlib.util
import inspect
import pkgutil
from collections.abc import Iterator

import pytest

from rare_envs.threads import use_one_thread

PACKAGES = ("samplers", "rare_envs", "agents", "training")


def names_of_modules(package: str) -> Iterator[str]:
    """Yield the dotted names of a package and all that stands in it."""
    yield package
    path = importlib.import_module(package).__path__
    yield from (module.name for module in pkgutil.walk_packages(path, f"{package}.") if "__main__" not in module.name)


MODULES = [name for package in PACKAGES for name in names_of_modules(package)]


def source(name: str) -> str:
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.origin is not None
    with open(spec.origin, encoding="utf-8") as file:
        return file.read()


def public_objects() -> dict[str, object]:
    """Return classes and functions that a package exports, each by its shortest name."""
    found: dict[int, tuple[str, object]] = {}
    packages = [name for name in MODULES if hasattr(importlib.import_module(name), "__path__")]
    for package in sorted(packages, key=lambda name: (name.count("."), name)):
        module = importlib.import_module(package)
        for name in getattr(module, "__all__", ()):
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isroutine(value):
                found.setdefault(id(value), (f"{package}.{name}", value))
    return dict(found.values())


def has_example(value: object) -> bool:
    """Return whether the docstring shows code and what it prints."""
    own = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    return any(example.want for example in doctest.DocTestParser().get_examples(own or ""))


WITHOUT_EXAMPLE = {
    "rare_envs.measures.stl": "needs rtamt, which runs on Python 3.11 or older; docs/measures.md has an example",
    "rare_envs.study.cli.main": "a program, which reads sys.argv and exits",
}
"""Public names without an example, and the reason."""


@pytest.mark.parametrize("name", [name for name in MODULES if ">>> " in source(name)])
@use_one_thread()
def test_examples_of_a_module(name: str) -> None:
    result = doctest.testmod(importlib.import_module(name), report=True)
    assert result.failed == 0
    assert result.attempted > 0


def test_everything_public_has_an_example() -> None:
    without = {name for name, value in public_objects().items() if not has_example(value)}
    assert without == set(WITHOUT_EXAMPLE)


def test_an_example_is_told_from_none() -> None:
    class Parent:
        """A class.

        >>> 1 + 1
        2
        """

    class Child(Parent):
        pass

    def silent() -> None:
        """Do nothing.

        >>> x = 1
        """

    assert [has_example(value) for value in (Parent, Child, silent)] == [True, False, False]
