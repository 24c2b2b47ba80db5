"""Everything public has an example, and the examples print what they show."""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil
from collections.abc import Iterator

import pytest

from rare_envs.startup import use_one_thread

PACKAGES = ("samplers", "rare_envs", "agents", "training")


def packages_in(name: str) -> Iterator[str]:
    """Yield the dotted names of a package and of the packages in it."""
    yield name
    for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f"{name}."):
        if module.ispkg:
            yield module.name


def public_objects() -> dict[str, object]:
    """Return classes and functions that packages export, each by its shortest name."""
    found: dict[int, tuple[str, object]] = {}
    packages = [name for package in PACKAGES for name in packages_in(package)]
    for package in sorted(packages, key=lambda name: (name.count("."), name)):
        module = importlib.import_module(package)
        for name in getattr(module, "__all__", ()):
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isroutine(value):
                found.setdefault(id(value), (f"{package}.{name}", value))
    return dict(found.values())


PUBLIC = public_objects()
WITHOUT_EXAMPLE = {
    "rare_envs.measures.stl": "needs rtamt, which runs on Python 3.11 or older; docs/measures.md has an example",
    "rare_envs.study.cli.main": "a program, which reads sys.argv and exits",
}
"""Public names without an example, and the reason."""


def examples_of(value: object, name: str) -> list[doctest.DocTest]:
    """Return the tests in the docstrings of a public object and of its methods."""
    space = vars(importlib.import_module(value.__module__))
    return [test for test in doctest.DocTestFinder().find(value, name, globs=dict(space)) if test.examples]


@pytest.mark.parametrize("name", sorted(set(PUBLIC) - set(WITHOUT_EXAMPLE)))
@use_one_thread()
def test_examples_of_a_public_name(name: str) -> None:
    own = inspect.getdoc(PUBLIC[name]) or ""
    assert any(example.want for example in doctest.DocTestParser().get_examples(own)), f"{name} has no example"
    runner = doctest.DocTestRunner()
    for test in examples_of(PUBLIC[name], name):
        assert runner.run(test).failed == 0, test.name


def test_names_without_an_example_are_public() -> None:
    assert set(WITHOUT_EXAMPLE) <= set(PUBLIC)
