"""Installation: what each package needs is declared, and what is missing is said in one line."""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

from rare_envs.startup import DRIVING, __version__

ROOT = Path(__file__).parents[2]
PACKAGES = ("agents", "rare_envs", "samplers", "training")
FROM_CLONE = f"pip install -e {shlex.quote(f'{ROOT}[driving]')}"
"""What installs the extra, in every working directory."""
OPTIONAL = {"dask", "openturns", "pandas", "ray"}
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
    assert outside == {"matplotlib", "pyarrow"}
    assert declared("dependencies") & declared("driving") == set()


BARE = f"""
import sys
from importlib.machinery import PathFinder


class Bare(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {DRIVING} else super().find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = Bare
if __name__ == "__main__":
    sys.argv[0] = "/somewhere/bin/rare-envs"
    from rare_envs.study.cli import main

    main()
"""
"""The command of an installation without the extra `driving`, in its worker processes too."""


@pytest.fixture
def bare(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the command where nothing of the extra `driving` can be found."""
    script = tmp_path / "bare.py"
    script.write_text(BARE, encoding="utf-8")

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(script), *words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)

    return run


@pytest.mark.parametrize("package", ["rare_envs", "agents", "training.ego_training"])
def test_importing_a_package_without_its_libraries_names_the_command(package: str) -> None:
    code = f"import sys; sys.modules.update(torch=None, gymnasium=None); import {package}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    line = f"rare_envs, agents and training need gymnasium, torch, not installed: {FROM_CLONE}."
    assert done.stderr.splitlines()[-1] == f"ImportError: {line}"


def test_version_and_help_need_no_library_of_the_extra(bare: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    for words, shown in ((["--version"], f"rare-envs {__version__}"), (["estimate", "--help"], "--max-sim")):
        done = bare(*words)
        assert (done.returncode, done.stderr) == (0, "")
        assert shown in done.stdout


def test_a_command_that_needs_the_extra_says_so_in_one_line(bare: Callable[..., Any]) -> None:
    for words in (["estimate", "CutIn-v0", "--seed", "1"], ["corpus", "run", "--ego", "idm"]):
        done = bare(*words)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
        command = "estimate" if words[0] == "estimate" else "corpus run"
        assert done.stderr.startswith(f"rare-envs: rare-envs {command} needs ")
        assert done.stderr.endswith(f"torch, yaml, not installed: {FROM_CLONE}.\n")
