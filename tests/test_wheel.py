"""The wheel installs alone: built here, installed into a fresh environment, used outside the checkout."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("agents", "rare_envs", "samplers", "training")


NO_CARS = """
from importlib.util import find_spec
import samplers
assert [name for name in ("torch", "gymnasium", "stable_baselines3", "cvxpy") if find_spec(name)] == []
problem = samplers.FunctionProblem(lambda u: 3.5 - u.sum(axis=1) / 10**0.5, dim=10)
for method in (name for name in samplers.methods.METHODS if name != "series"):  # terms with gradients
    workers = 2 if method == "mc" else None
    print(method, samplers.estimate(problem, method, seed=0, max_sim=3000, workers=workers).p)
"""
"""An estimate by every method, one of them by two processes, where a plain installation is all there is."""


def run(*words: str | Path, cwd: Path, codes: tuple[int, ...] = (0, 3)) -> str:
    """Return what a command prints, run in a folder without this checkout on its path."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(word) for word in words], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode in codes, f"{words} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done.stdout or done.stderr


def shipped_files() -> set[str]:
    """Return the files that `[tool.setuptools.package-data]` names and the modules of the packages."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text[text.index("[tool.setuptools.package-data]") :].partition("\n\n")[0]
    patterns = {
        name: ast.literal_eval(found) for name, found in re.findall(r"^(\w+) = (\[.*\])$", section, re.MULTILINE)
    }
    assert set(patterns) == set(PACKAGES)
    data = {path for name in PACKAGES for pattern in patterns[name] for path in (ROOT / name).glob(pattern)}
    modules = {path for name in PACKAGES for path in (ROOT / name).rglob("*.py")}
    return {path.relative_to(ROOT).as_posix() for path in data | modules}


def test_data_files_are_named() -> None:
    files = shipped_files()
    assert "agents/data/imitation.safetensors" in files
    assert {f"{name}/py.typed" for name in PACKAGES} <= files
    unnamed = {
        path.relative_to(ROOT).as_posix()
        for name in PACKAGES
        for path in (ROOT / name).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert unnamed - files == set()


@pytest.mark.slow
def test_an_estimate_from_the_wheel_outside_the_checkout(tmp_path: Path) -> None:
    source = tmp_path / "source"  # a build leaves files behind, and takes up those of an earlier one
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / file, source)
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, source, cwd=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert inside == shipped_files()
    run(sys.executable, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
    scripts = tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin")
    pinned = ("-c", ROOT / "constraints.txt")
    run(scripts / "python", "-m", "pip", "install", "--quiet", *pinned, wheel, cwd=tmp_path)
    found = dict(line.split() for line in run(scripts / "python", "-c", NO_CARS, cwd=tmp_path).splitlines())
    assert set(found) >= {"mc", "ss", "ce", "two-stage", "surrogate"}
    assert 1.5e-4 < float(found["two-stage"]) < 3.5e-4  # Phi(-3.5) = 2.33e-4
    assert re.fullmatch(r"rare-envs \d+\.\d+\.\d+\n", run(scripts / "rare-envs", "--version", cwd=tmp_path))
    assert "estimate" in run(scripts / "rare-envs", "--help", cwd=tmp_path)
    told = run(scripts / "rare-envs", "list", cwd=tmp_path, codes=(2,))
    advice = re.fullmatch(r"rare-envs: rare-envs list needs .*torch.*: (pip install '.*')\.\n", told)
    assert advice is not None
    run(scripts / "python", "-m", *shlex.split(advice[1]), "--quiet", *pinned, cwd=tmp_path)
    where = run(scripts / "python", "-c", "import rare_envs; print(rare_envs.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(tmp_path / "venv")
    words = ("estimate", "rare_envs/CutIn-v0", "--ego", "idm", "--seed", "0", "--max-sim", "3000", "--json")
    answer = json.loads(run(scripts / "rare-envs", *words, "--out", "runs/cutin", cwd=tmp_path))
    assert answer["interval"][0] < 1.2e-3 < answer["interval"][1]
    assert (tmp_path / "runs/cutin/episodes.parquet").is_file()
