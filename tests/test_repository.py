"""The repository: imports run one way without a circle, what is shipped is named, every page is found."""

from __future__ import annotations

import ast
import graphlib
import json
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
STUDY = "rare_envs.study"
PACKAGES = ("samplers", "rare_envs", "agents", "training")
MAY_IMPORT = {
    "samplers": set(),
    "rare_envs": set(),
    "agents": {"rare_envs"},
    "training": {"agents", "rare_envs", "samplers"},
    STUDY: set(PACKAGES),
}
"""Who may import whom among the packages; `rare_envs.study` is the top floor, and nobody below imports it."""
LIBRARIES = {"samplers": {"gymnasium", "highway_env", "pettingzoo", "stable_baselines3", "torch"}}
"""Libraries that a package must do without."""
SHIPPED = sorted([*ROOT.glob("rare_envs/data/*.json"), *ROOT.glob("agents/data/*.safetensors")])
SHARE_ALIKE = "CC BY-SA 3.0"


def modules(root: Path) -> dict[str, Path]:
    """Return dotted name to file of every module of the packages."""
    found = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path: Path, module: str, known: frozenset[str]) -> Iterator[str]:
    """Yield the dotted names that a module imports; `from a import b` names `a.b` where that is a module.

    Imports in function bodies and under TYPE_CHECKING count: an import inside a function that avoids a circle is the
    circle. The values of a table `_LAZY` are modules that a package imports on first use.
    """
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            if node.level:
                up = module.split(".")[: len(module.split(".")) - node.level + (path.name == "__init__.py")]
                source = ".".join([*up, *([source] if source else [])])
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                yield inner if inner in known else source
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "_LAZY":
            yield from ast.literal_eval(node.value).values()


def import_graph(root: Path) -> dict[str, set[str]]:
    """Return what each module imports."""
    files = modules(root)
    known = frozenset(files)
    return {module: set(imported(path, module, known)) - {module} for module, path in files.items()}


def package_of(module: str) -> str:
    """Return the row of MAY_IMPORT that a module belongs to; `python -m rare_envs` is the command line."""
    top = f"{module}.".startswith(f"{STUDY}.") or module == "rare_envs.__main__"
    return STUDY if top else module.partition(".")[0]


def reaching_up(root: Path) -> list[str]:
    """Return imports that MAY_IMPORT or LIBRARIES do not allow; `rare_envs` itself re-exports what it likes."""
    wrong = []
    for module, names in import_graph(root).items():
        package = package_of(module)
        for name in sorted(names):
            other = package_of(name)
            up = other != package and other in MAY_IMPORT and other not in MAY_IMPORT[package]
            if (up and module != "rare_envs") or other in LIBRARIES.get(package, ()):
                wrong.append(f"{module} imports {name}")
    return wrong


def import_order(root: Path) -> list[str]:
    """Return the modules in an order in which each comes after what it imports.

    Raises:
        graphlib.CycleError: If there is none.
    """
    graph = import_graph(root)
    inside = {module: {name for name in names if name in graph} for module, names in graph.items()}
    return list(graphlib.TopologicalSorter(inside).static_order())


def test_packages_import_only_what_the_table_allows() -> None:
    assert reaching_up(ROOT) == []


def test_there_is_no_circle() -> None:
    assert set(import_order(ROOT)) == set(modules(ROOT))


def test_a_forbidden_import_and_a_circle_are_found(tmp_path: Path) -> None:
    (tmp_path / "samplers").mkdir()
    a, b = tmp_path / "samplers/a.py", tmp_path / "samplers/b.py"
    b.write_text("")
    for line in ("import torch", "from rare_envs.simulation import world", "def f():\n    import rare_envs.study.cli"):
        a.write_text(line)
        assert len(reaching_up(tmp_path)) == 1
    a.write_text("from samplers import b")
    assert import_order(tmp_path) == ["samplers.b", "samplers.a"]
    b.write_text("def f():\n    import samplers.a")
    with pytest.raises(graphlib.CycleError):
        import_order(tmp_path)


def stated(path: Path) -> str:
    """Return what a shipped file says of itself."""
    if path.suffix == ".json":
        return json.dumps(json.loads(path.read_text(encoding="utf-8")).get("provenance", {}))
    with path.open("rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        return json.dumps(json.loads(file.read(length))["__metadata__"])


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_notice_names_a_shipped_file_with_its_licence(path: Path) -> None:
    sections = (ROOT / "NOTICE").read_text(encoding="utf-8").split("\n\n")
    name = path.relative_to(ROOT).as_posix()
    (section,) = (section for section in sections if f"  {name}\n" in f"{section}\n")
    assert (SHARE_ALIKE in section) == (SHARE_ALIKE in stated(path)), section


def test_the_notice_names_no_file_that_is_not_shipped() -> None:
    lines = (ROOT / "NOTICE").read_text(encoding="utf-8").splitlines()
    names = {line.strip() for line in lines if line.startswith(("  rare_envs/", "  agents/"))}
    assert names == {path.relative_to(ROOT).as_posix() for path in SHIPPED}


def pages_in(nav: list) -> Iterator[str]:
    """Yield the pages of a navigation tree."""
    for entry in nav:
        for value in entry.values() if isinstance(entry, dict) else [entry]:
            yield from pages_in(value) if isinstance(value, list) else [value]


def test_every_page_is_in_the_navigation_once() -> None:
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    built = {"notice.md", "model_cards.md"}  # of files outside docs/
    assert sorted(set(pages_in(nav)) - built) == sorted(
        str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").rglob("*.md")
    )
