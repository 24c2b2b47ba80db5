"""Installation: what each package needs is declared, and what is missing is said in one line."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from rare_envs.installation import DRIVING, require_libraries

ROOT = Path(__file__).parents[2]
PACKAGES = ("agents", "rare_envs", "samplers", "training")
OPTIONAL = {"dask", "openturns", "pandas", "ray", "UQpy"}
"""Libraries that users bring themselves, or that an extra of `samplers` installs."""


def declared(key: str) -> set[str]:
    """Return the distributions that a list of pyproject.toml names, without versions."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    found = re.search(rf"^{key} = (\[.*?\])$", text, re.DOTALL | re.MULTILINE)
    assert found is not None
    return {re.split(r"[<>=;\[]", item)[0].lower() for item in ast.literal_eval(found[1])}


def imported(package: str) -> set[str]:
    """Return the libraries that a package imports, those in functions included, outside TYPE_CHECKING."""
    names: set[str] = set()
    for path in (ROOT / package).rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        conditions = [node for node in ast.walk(tree) if isinstance(node, ast.If)]
        typing_only = [node for node in conditions if ast.unparse(node.test) == "TYPE_CHECKING"]
        skipped = {inner for node in typing_only for part in node.body for inner in ast.walk(part)}
        for node in set(ast.walk(tree)) - skipped:
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.partition(".")[0])
    return names - set(sys.stdlib_module_names) - set(PACKAGES)


def test_the_list_of_modules_is_the_extra() -> None:
    where = packages_distributions()
    assert {where[module][0].lower().replace("_", "-") for module in DRIVING} == declared("driving")


def test_samplers_imports_nothing_that_is_not_installed_with_it_unless_it_says_so() -> None:
    where = packages_distributions()
    libraries = imported("samplers") - OPTIONAL
    outside = {name for name in libraries if where[name][0].lower() not in declared("dependencies")}
    assert outside == {"matplotlib", "pyarrow", "threadpoolctl"}  # threadpoolctl comes with scikit-learn
    assert declared("dependencies") & declared("driving") == set()


def test_what_the_test_suite_needs_is_installed_by_its_extra() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (extras,) = re.findall(r'^  "rare-envs\[([a-z,0-9]+)\]",$', text, re.MULTILINE)
    assert set(extras.split(",")) >= {"driving", "contrib", "export", "fast", "logs", "onnx", "remote", "stl"}


@pytest.mark.parametrize("package", ["rare_envs", "agents", "training"])
def test_importing_a_package_without_its_libraries_names_the_command(package: str) -> None:
    code = f"import sys; sys.modules.update(torch=None, typer=None); import {package}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    line = "rare_envs, agents and training need torch, typer, not installed: pip install 'rare-envs[driving]'."
    assert done.stderr.splitlines()[-1] == f"ImportError: {line}"


def test_the_command_line_says_it_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/rare-envs", "list"])
    with pytest.raises(SystemExit) as stopped:
        require_libraries(("torch", "no_such_library"))
    assert stopped.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
