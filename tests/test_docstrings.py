"""Everything public has an example, the examples print what they show, and all texts use the words of the field."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest
import yaml

from rare_envs.startup import use_one_thread
from rare_envs.study.compared_risks import compare_risks

PACKAGES = ("samplers", "rare_envs", "agents", "training")
MODULES = [f"samplers.{name}" for name in ("comparison", "distributions", "executors", "problem", "run", "strata")]
"""Modules that are public and no packages."""
ROOT = Path(__file__).parents[1]
WORDS = yaml.safe_load((ROOT / "tests/words.yaml").read_text())


def modules_in(name: str) -> Iterator[str]:
    """Yield the dotted names of a package, of the packages in it and of MODULES."""
    yield name
    for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f"{name}."):
        if module.ispkg or module.name in MODULES:
            yield module.name


def public_objects() -> dict[str, object]:
    """Return classes and functions that packages export, each by its shortest name."""
    found: dict[int, tuple[str, object]] = {}
    modules = [name for package in PACKAGES for name in modules_in(package)]
    for package in sorted(modules, key=lambda name: (name.count("."), name)):
        module = importlib.import_module(package)
        for name in getattr(module, "__all__", ()):
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isroutine(value):
                found.setdefault(id(value), (f"{package}.{name}", value))
    return dict(found.values())


PUBLIC = public_objects() | {"rare_envs.study.compared_risks.compare_risks": compare_risks}
WITHOUT_EXAMPLE = {
    "rare_envs.measures.stl": "needs rtamt, which runs on Python 3.11 or older; docs/measures.md has an example",
    "rare_envs.study.cli.main": "a program, which reads sys.argv and exits",
}
"""Public names without an example, and the reason."""


def examples_of(value: object, name: str) -> list[doctest.DocTest]:
    """Return the tests in the docstrings of a public object and of its methods; those at the top can be pasted."""
    pasted = name.count(".") == 1 or name.startswith("samplers.")
    space = {} if pasted else vars(importlib.import_module(value.__module__))
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


def messages_in(path: Path) -> Iterator[str]:
    """Yield the texts of three words or more in a module, but for docstrings: messages, help texts, labels."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr | ast.Expr) for part in ast.walk(node)}
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.value


def texts_of_users() -> Iterator[tuple[str, str]]:
    """Yield a place and a text of each paragraph, message and public docstring."""
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        yield from ((str(path.relative_to(ROOT)), text) for text in path.read_text(encoding="utf-8").split("\n\n"))
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield from ((str(path.relative_to(ROOT)), text) for text in messages_in(path) if len(text.split()) > 2)
    for name, value in PUBLIC.items():
        members = vars(value) if inspect.isclass(value) else {}
        for each in (value, *(member for key, member in members.items() if not key.startswith("_"))):
            about = "" if each.__doc__ == type(each).__doc__ else inspect.getdoc(each) or ""
            yield from ((name, text) for text in about.split("\n\n"))


def words_to_avoid(place: str, text: str) -> Iterator[str]:
    """Yield what a text says in words of `WORDS`, and what to write in their place."""
    of_driving = not any(fnmatch(place, known) for known in WORDS["probability"])
    for pattern, better in [*WORDS["everywhere"], *(WORDS["driving"] if of_driving else [])]:
        if not any(fnmatch(place, known) and allowed in pattern for known, allowed, _ in WORDS["allowed"]):
            for found in re.finditer(pattern, " ".join(text.split())):
                yield f"{place}: {found[0]!r} -> {better}"


def test_texts_use_the_words_of_the_field() -> None:
    found = [each for place, text in texts_of_users() for each in words_to_avoid(place, text)]
    assert not found, "\n".join(found)


def test_words_to_avoid_are_found() -> None:
    assert list(words_to_avoid("docs/a.md", "Where nothing fails, p holds\nthe true value in brackets; c.o.v. 0.1."))
    assert not list(words_to_avoid("samplers/a.py", "If nothing fails, the interval covers p; c.o.v. 0.1."))
