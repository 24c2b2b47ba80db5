"""Imports run one way, without a circle, through folders of a readable size; read from the import statements."""

from __future__ import annotations

import ast
import functools
import graphlib
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

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
DOORS = {"rare_envs": {"rare_envs.study.rates.total_risk", "rare_envs.study.storage.loaded_study"}}
"""A package to what it re-exports from the top floor, on first use; these import modules of it only."""

FLOORS = {
    "samplers": """
        errors trace validation serialization distributions system
        problem
        sample proposals limit_states
        presentation
        statistics
        analysis method
        presentation.estimate_display
        result importance mcmc methods.two_stage.mixture
        execution
        methods
        methods.cross_entropy methods.two_stage
        methods.surrogate
        methods.auto
        registry
        estimation
        comparison testing benchmark
    """,
    "rare_envs": """
        version startup
        devices
        traffic plugins arrays threads json_text files code_trust compilation
        distributions control sensors
        sensors.camera scenarios measures
        simulation
        egos make terms
        core_choice
        multi_agent interop problem
        envs
        exposure
        registration
        study
        study.ego_check study.rates
        study.html_report
        study.reproduction
        study.cli
    """,
    "agents": """
        names settings missing_file
        python_function
        learned sb3 remote imperfect_stack
        vision onnx
        loading
        ego_process
    """,
    "training": """
        command_line data vec_env ego_checkpoint ego_retraining
        scenario_fitting imitation.traffic ego_training
        imitation.algorithms imitation.evaluation
        imitation
        egos
    """,
}
"""Low to high: a part may import itself and what stands in a line above its own, never its neighbours. A module
belongs to the longest name that it begins with; the `__init__` of a package and `__main__` may import all."""

MOST_MODULES = 13
"""Modules side by side in one folder: a folder is the first page that a newcomer reads."""
CARS_AND_TENSORS = {"gymnasium", "highway_env", "pettingzoo", "stable_baselines3", "torch"}


EXAMPLES = sorted((ROOT / "examples").rglob("*.py"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PUBLIC_MODULES = {"samplers.testing", "samplers.benchmark"}
"""Modules that users import as such: checks and a benchmark for methods of other packages."""


def modules(root: Path, packages: tuple[str, ...] = PACKAGES) -> dict[str, Path]:
    """Return dotted name to file of every module of the packages."""
    found = {}
    for package in packages:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@functools.cache
def imported(text: str, module: str, is_package: bool, known: frozenset[str]) -> frozenset[str]:
    """Return the dotted names that a text imports; `from a import b` names `a.b` where that is a module.

    The values of a table `_LAZY` are modules that a package imports on first use.
    """
    return frozenset(_imported(ast.parse(text), module, is_package, known))


def _imported(tree: ast.AST, module: str, is_package: bool, known: frozenset[str]) -> Iterator[str]:
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
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "_LAZY":
            yield from ast.literal_eval(node.value).values()


def import_graph(root: Path, packages: tuple[str, ...] = PACKAGES) -> dict[str, set[str]]:
    """Return which names each module imports, those in function bodies and under TYPE_CHECKING included.

    An import inside a function that avoids a circle is the circle.
    """
    files = modules(root, packages)
    known = frozenset(files)
    graph = {}
    for module, path in files.items():
        text = path.read_text(encoding="utf-8")
        graph[module] = set(imported(text, module, path.name == "__init__.py", known)) - {module}
    return graph


def package_of(module: str) -> str:
    """Return the row of MAY_IMPORT that a module belongs to; `python -m rare_envs` is the command line."""
    top = f"{module}.".startswith(f"{STUDY}.") or module == "rare_envs.__main__"
    return STUDY if top else module.partition(".")[0]


@functools.cache
def floors() -> dict[str, int]:
    """Return the floor of every part, by its dotted name."""
    return {
        f"{package}.{part}": floor
        for package, table in FLOORS.items()
        for floor, line in enumerate(table.strip().splitlines())
        for part in line.split()
    }


def part_of(module: str) -> str | None:
    """Return the part of the table that a module belongs to; None for the packages themselves and `__main__`."""
    known = floors()
    while module:
        if module in known:
            return module
        module = module.rpartition(".")[0]
    return None


def between_packages(root: Path) -> list[str]:
    """Return imports that MAY_IMPORT does not allow."""
    wrong = []
    for module, names in import_graph(root).items():
        package = package_of(module)
        for name in sorted(names):
            other = package_of(name)
            reaches_up = other != package and other in MAY_IMPORT and other not in MAY_IMPORT[package]
            drives = package == "samplers" and other in CARS_AND_TENSORS
            if (reaches_up or drives) and name not in DOORS.get(module, ()):
                wrong.append(f"{module} imports {name}")
    return wrong


def between_floors(root: Path) -> list[str]:
    """Return imports inside a package that do not go down the table FLOORS, and modules that it does not name."""
    known, wrong = floors(), []
    for module, names in import_graph(root).items():
        part = part_of(module)
        if part is None:
            if module not in PACKAGES and module != "rare_envs.__main__":
                wrong.append(f"{module} stands on no floor")
            continue
        for name in sorted(names):
            other = part_of(name)
            same_package = name.partition(".")[0] == module.partition(".")[0]
            if same_package and name in PACKAGES and package_of(module) != STUDY:
                wrong.append(f"{module} imports the whole package {name}")
            if same_package and other not in (None, part) and known[other] >= known[part]:
                wrong.append(f"{module} imports {name}")
    return wrong


def import_order(root: Path, packages: tuple[str, ...] = PACKAGES) -> list[str]:
    """Return the modules in an order in which each comes after what it imports.

    Raises:
        graphlib.CycleError: If there is none.
    """
    graph = import_graph(root, packages)
    inside = {module: {name for name in names if name in graph} for module, names in graph.items()}
    return list(graphlib.TopologicalSorter(inside).static_order())


def crowded(root: Path, packages: tuple[str, ...] = PACKAGES) -> dict[str, int]:
    """Return the folders with more than MOST_MODULES modules of their own."""
    files = modules(root, packages).values()
    sizes = Counter(str(path.parent.relative_to(root)) for path in files if path.name != "__init__.py")
    return {folder: size for folder, size in sizes.items() if size > MOST_MODULES}


def exported(path: Path) -> frozenset[str]:
    """Return the names in the `__all__` of a module."""
    return _exported(path.read_text(encoding="utf-8"))


@functools.cache
def _exported(text: str) -> frozenset[str]:
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return frozenset(name for name in ast.literal_eval(node.value) if isinstance(name, str))
    return frozenset()


def shadowed(root: Path) -> list[str]:
    """Return modules with the name of something that their package exports: the one would hide the other."""
    files = modules(root)
    return [
        f"{package}.{name}"
        for package, path in files.items()
        if path.name == "__init__.py"
        for name in sorted(exported(path))
        if f"{package}.{name}" in files
    ]


def deep_imports(text: str, files: dict[str, Path]) -> list[str]:
    """Return import statements of Python code that reach into a module where a package should export the name."""
    wrong = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module in files and node.module not in PUBLIC_MODULES:
            path = files[node.module]
            names = [alias.name for alias in node.names]
            public = path.name == "__init__.py" and all(
                name in exported(path) or f"{node.module}.{name}" in files for name in names
            )
            if not public:
                wrong.append(ast.unparse(node))
        elif isinstance(node, ast.Import):
            wrong += [
                ast.unparse(node)
                for alias in node.names
                if alias.name in files and alias.name not in packages_of(files)
            ]
    return wrong


def packages_of(files: dict[str, Path]) -> set[str]:
    """Return the modules that are packages."""
    return {name for name, path in files.items() if path.name == "__init__.py"}


def test_packages_import_only_what_the_table_allows() -> None:
    assert between_packages(ROOT) == []


def test_inside_a_package_imports_go_down() -> None:
    assert between_floors(ROOT) == []


def test_there_is_no_circle() -> None:
    everything = (*PACKAGES, "benchmarks")
    assert set(import_order(ROOT, everything)) == set(modules(ROOT, everything))


def test_folders_are_of_a_readable_size() -> None:
    assert crowded(ROOT, (*PACKAGES, "benchmarks")) == {}


def test_no_module_hides_what_its_package_exports() -> None:
    assert shadowed(ROOT) == []


def test_every_name_that_a_package_exports_is_there() -> None:
    for package in packages_of(modules(ROOT)):
        names = exported(modules(ROOT)[package])
        module = __import__(package, fromlist=["*"])
        assert [name for name in sorted(names) if not hasattr(module, name)] == [], package


def test_the_tree_is_really_read() -> None:
    found = modules(ROOT)
    assert {"samplers.result", "rare_envs.simulation.world", "agents.loading", f"{STUDY}.cli.app"} <= set(found)
    assert "rare_envs.traffic.state" in import_graph(ROOT)["rare_envs.simulation.world"]
    assert len(floors()) >= 60


def tree_of(root: Path, files: dict[str, str]) -> None:
    """Write a made-up tree."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


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
    tree_of(tmp_path, {file: "import numpy\n", "rare_envs/study/cli/__init__.py": "import numpy\n"})
    assert between_packages(tmp_path) == []
    (tmp_path / file).write_text(line)
    assert len(between_packages(tmp_path)) == 1


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("samplers/method.py", "def f():\n    from samplers.execution.run import Run"),
        ("samplers/mcmc/kernels.py", "from samplers.importance.draws import Draws"),
        ("rare_envs/traffic/lead.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import rare_envs.make"),
        ("rare_envs/make.py", "import rare_envs"),
        ("training/stray.py", ""),
    ],
)
def test_an_import_up_the_table_is_found(tmp_path: Path, file: str, line: str) -> None:
    names = ("samplers/execution/run.py", "samplers/importance/draws.py", "rare_envs/make.py", "rare_envs/__init__.py")
    tree_of(tmp_path, dict.fromkeys(names, ""))
    assert between_floors(tmp_path) == []
    tree_of(tmp_path, {file: line})
    assert len(between_floors(tmp_path)) == 1


def test_a_circle_is_found_lazy_imports_counted(tmp_path: Path) -> None:
    tree_of(tmp_path, {"samplers/a.py": "from samplers import b", "samplers/b.py": ""})
    assert import_order(tmp_path) == ["samplers.b", "samplers.a"]
    for hidden in (
        "def f():\n    import samplers.a",
        "if TYPE_CHECKING:\n    from samplers.a import x",
        "_LAZY = {'x': 'samplers.a'}",
    ):
        tree_of(tmp_path, {"samplers/b.py": hidden})
        with pytest.raises(graphlib.CycleError):
            import_order(tmp_path)


def test_a_crowded_folder_and_a_hidden_function_are_found(tmp_path: Path) -> None:
    tree_of(tmp_path, {f"samplers/m{i}.py": "" for i in range(MOST_MODULES + 1)})
    assert crowded(tmp_path) == {"samplers": MOST_MODULES + 1}
    tree_of(tmp_path, {"samplers/__init__.py": "from samplers.m1 import m2\n__all__ = ['m2']"})
    assert shadowed(tmp_path) == ["samplers.m2"]


def test_a_deep_path_is_found() -> None:
    files = modules(ROOT)
    assert deep_imports("import samplers\nfrom samplers import estimate\nfrom rare_envs import interop", files) == []
    assert len(deep_imports("from samplers.estimation import estimate\nimport rare_envs.simulation.world", files)) == 2


def test_every_package_is_installed_by_name() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text[text.index("[tool.setuptools]") :]
    listed = re.search(r"^packages = (\[.*?\])", section, re.DOTALL | re.MULTILINE)
    assert listed is not None
    in_tree = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for package in PACKAGES
        for path in (ROOT / package).rglob("__init__.py")
    }
    assert set(ast.literal_eval(listed[1])) == in_tree
    with_code = {package_of(m) for m in modules(ROOT)}
    assert with_code == set(MAY_IMPORT)


@pytest.mark.parametrize("package", PACKAGES)
def test_type_information_is_shipped(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_need_no_deep_path(path: Path) -> None:
    assert deep_imports(path.read_text(encoding="utf-8"), modules(ROOT)) == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_pages_need_no_deep_path(path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)
    assert [line for block in blocks for line in deep_imports(block, modules(ROOT))] == []
