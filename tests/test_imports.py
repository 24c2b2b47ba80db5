"""Imports run one way: who may know whom, read from the import statements."""

from __future__ import annotations

import ast
import graphlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
STUDY = "rare_envs.study"
OURS = ("agents", "rare_envs", "samplers", "training")
MAY_IMPORT = {
    "samplers": set(),
    "rare_envs": set(),
    "agents": {"rare_envs"},
    "training": {"agents", "rare_envs", "samplers"},
    STUDY: set(OURS),
}
CARS_AND_TENSORS = {"gymnasium", "highway_env", "pettingzoo", "stable_baselines3", "torch"}


def modules(root: Path) -> dict[str, Path]:
    """Dotted name to file of every module of the four packages."""
    found = {}
    for package in OURS:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(tree: ast.AST, module: str, is_package: bool, known: set[str]) -> Iterator[str]:
    """Dotted names that a tree imports; `from a import b` names `a.b` where that is a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            if node.level:
                up = module.split(".")[: len(module.split(".")) - node.level + is_package]
                source = ".".join([*up, *([source] if source else [])])
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                yield inner if inner in known else source


def without_lazy_parts(tree: ast.Module) -> ast.Module:
    """What runs when a module is imported: no function bodies, nothing under `if TYPE_CHECKING`."""

    class Strip(ast.NodeTransformer):
        def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
            return None

        visit_AsyncFunctionDef = visit_FunctionDef  # type: ignore[assignment]

        def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
            typing_only = "TYPE_CHECKING" in ast.unparse(node.test)
            return node.orelse if typing_only else self.generic_visit(node)

    return Strip().visit(tree)


def package_of(module: str) -> str:
    """The row of the table that a module belongs to; `python -m rare_envs` is the command line."""
    top = f"{module}.".startswith(f"{STUDY}.") or module == "rare_envs.__main__"
    return STUDY if top else module.partition(".")[0]


def violations(root: Path) -> list[str]:
    """Imports that the table does not allow, lazy and typing-only ones included."""
    files = modules(root)
    wrong = []
    for module, path in files.items():
        package = package_of(module)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for name in imported(tree, module, path.name == "__init__.py", set(files)):
            other = package_of(name)
            if other == package:
                continue
            reaches_up = other in MAY_IMPORT and other not in MAY_IMPORT[package]
            drives = package == "samplers" and other in CARS_AND_TENSORS
            if reaches_up or drives:
                wrong.append(f"{module} imports {name}")
    return wrong


def import_order(root: Path) -> list[str]:
    """Modules in an order in which each comes after what it imports.

    Raises:
        graphlib.CycleError: There is none.
    """
    files = modules(root)
    graph = {}
    for module, path in files.items():
        tree = without_lazy_parts(ast.parse(path.read_text(encoding="utf-8")))
        names = imported(tree, module, path.name == "__init__.py", set(files))
        graph[module] = {name for name in names if name in files and name != module}
    return list(graphlib.TopologicalSorter(graph).static_order())


def test_packages_import_only_what_the_table_allows() -> None:
    assert violations(ROOT) == []


def test_there_is_no_import_cycle() -> None:
    assert set(import_order(ROOT)) == set(modules(ROOT))


def test_the_tree_is_really_read() -> None:
    found = modules(ROOT)
    assert {"samplers.result", "rare_envs.simulation.world", "agents.loading", "training.vec_env", f"{STUDY}.cli"} <= set(found)


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("samplers/estimation.py", "import torch"),
        ("samplers/estimation.py", "from rare_envs.simulation import world"),
        ("rare_envs/simulation/world.py", "from samplers.result import Estimate"),
        ("rare_envs/simulation/world.py", "def f():\n    from agents import load_ego"),
        ("rare_envs/simulation/world.py", "from ..study import cli"),
        ("rare_envs/simulation/world.py", "import rare_envs.study.cli"),
        ("agents/loading.py", "import training"),
        ("training/vec_env.py", "from rare_envs.study.cli import main"),
    ],
)
def test_a_forbidden_import_is_found(tmp_path: Path, file: str, line: str) -> None:
    for path in (file, "rare_envs/study/cli/__init__.py"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text("import numpy\n")
    assert violations(tmp_path) == []
    (tmp_path / file).write_text(line)
    assert len(violations(tmp_path)) == 1


def test_a_cycle_is_found_and_a_lazy_import_is_none(tmp_path: Path) -> None:
    (tmp_path / "samplers").mkdir()
    (tmp_path / "samplers" / "a.py").write_text("from samplers import b")
    (tmp_path / "samplers" / "b.py").write_text("def f():\n    import samplers.a")
    assert import_order(tmp_path) == ["samplers.b", "samplers.a"]
    (tmp_path / "samplers" / "b.py").write_text("import samplers.a")
    with pytest.raises(graphlib.CycleError):
        import_order(tmp_path)


def test_every_package_is_installed_by_name() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text[text.index("[tool.setuptools]") :]
    listed = re.search(r"^packages = (\[.*?\])", section, re.DOTALL | re.MULTILINE)
    assert listed is not None
    in_tree = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for package in OURS
        for path in (ROOT / package).rglob("__init__.py")
    }
    assert set(ast.literal_eval(listed[1])) == in_tree
    with_code = {package_of(m) for m in modules(ROOT)}
    assert with_code == set(MAY_IMPORT)


@pytest.mark.parametrize("package", OURS)
def test_type_information_is_shipped(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()
