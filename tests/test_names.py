"""Names: one name has one meaning, docstrings begin with the thing itself, tests stand where the code stands."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("samplers", "rare_envs", "agents", "training")

FAMILIES = {
    "initial": "start of a scenario, a field of `Scenario`",
    "others": "script of the other vehicles, a field of `Scenario`",
    "driven": "motion of vehicles with drivers, a field of `Scenario`",
    "main": "entry of a program",
    "Distribution": "protocol of a base distribution, in the two halves, which do not import each other",
    "ConditionalProblem": "protocol of a problem that holds something fixed, likewise",
    "FloatArray": "arrays in double precision, likewise",
}
"""Public names that several modules define, each in the same role, and the role."""

TWINS = ("rare_envs/simulation/compiled/equations.py", "rare_envs/simulation/compiled/rollouts.py")
"""Modules whose functions are compiled twins of torch functions, and have their names."""

QUESTION_WORDS = ("What", "How", "Where", "When", "Who", "Which", "Whether", "Why")


@pytest.fixture(scope="module")
def sources() -> dict[str, ast.Module]:
    """Return the syntax tree of every module of the packages, by its path in the repository."""
    return {
        str(path.relative_to(ROOT)): ast.parse(path.read_text(encoding="utf-8"))
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    }


def public_names(tree: ast.Module) -> Iterator[str]:
    """Yield the names that a module defines at its top level for others."""
    for node in tree.body:
        names: list[str] = []
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            names = [name.id for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names = [node.target.id]
        yield from (name for name in names if not name.startswith("_"))


def defined_twice(trees: dict[str, ast.Module]) -> dict[str, list[str]]:
    """Return public names that more than one module defines, and these modules."""
    places = defaultdict(list)
    for path, tree in trees.items():
        functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        for name in set(public_names(tree)) - (functions if path in TWINS else set()):
            places[name].append(path)
    return {name: paths for name, paths in sorted(places.items()) if len(paths) > 1}


def holds_logic(tree: ast.Module) -> bool:
    """Return whether a module has a function or method that computes: with a branch, a loop or arithmetic."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    kinds = (ast.If, ast.For, ast.While, ast.BinOp, ast.Compare, ast.comprehension)
    return any(isinstance(node, kinds) for function in functions for node in ast.walk(function))


def test_module_of(path: str) -> Path:
    """Return where the tests of a module stand."""
    module = Path(path)
    return ROOT / "tests" / module.parent / f"test_{module.name}"


test_module_of.__test__ = False  # type: ignore[attr-defined]  # pytest takes its name for a test


def test_one_name_has_one_meaning(sources: dict[str, ast.Module]) -> None:
    twice = {name: paths for name, paths in defined_twice(sources).items() if name not in FAMILIES}
    assert twice == {}


def test_a_family_has_several_members(sources: dict[str, ast.Module]) -> None:
    assert set(FAMILIES) - set(defined_twice(sources)) == set()


def test_a_module_says_what_it_is(sources: dict[str, ast.Module]) -> None:
    first_words = {path: (ast.get_docstring(tree) or "").partition(" ")[0] for path, tree in sources.items()}
    assert [path for path, word in first_words.items() if not word or word in QUESTION_WORDS] == []


def test_every_module_with_logic_has_its_tests(sources: dict[str, ast.Module]) -> None:
    without = {
        path
        for path, tree in sources.items()
        if not path.endswith(("__init__.py", "__main__.py")) and holds_logic(tree) and not test_module_of(path).exists()
    }
    assert without == set()


def test_names_and_logic_are_recognised() -> None:
    trees = {
        "a.py": ast.parse("X, _y = 1, 2\ndef f(): return X + 1\n"),
        "b.py": ast.parse("X: int = 1\nclass C:\n    def f(self): return 1\n"),
    }
    assert defined_twice(trees) == {"X": ["a.py", "b.py"]}
    assert [holds_logic(tree) for tree in trees.values()] == [True, False]
