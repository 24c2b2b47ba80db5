"""`samplers` alone: it needs no torch, Stable-Baselines3, cvxpy or Gymnasium."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import samplers
from samplers.distributions import project_mean

SCRIPT = Path(__file__).with_name("without_drivers.py")
ROOT = Path(__file__).parents[2]
LEARNING = "numpy,scipy,sklearn,joblib,cloudpickle,threadpoolctl,narwhals"
"""scikit-learn and what it needs itself."""
P = 1.3499e-3
"""Phi(-3)."""


def estimate_without(packages: str, methods: str) -> subprocess.CompletedProcess[str]:
    """Return a finished process that could import these packages only."""
    command = [sys.executable, "-W", "error", str(SCRIPT), packages, methods]
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment, check=False)


@pytest.mark.parametrize(
    ("packages", "methods"),
    [("numpy,scipy", "mc,is,ce,ice,ss,adss"), pytest.param(LEARNING, "two-stage,surrogate", marks=pytest.mark.slow)],
)
def test_estimates_where_nothing_else_is_installed(packages: str, methods: str) -> None:
    done = estimate_without(packages, methods)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [name for name, *_ in lines] == methods.split(",")
    assert all(0.2 * P < float(p) < 5.0 * P and 0 < int(n_sim) <= 3000 for _, p, n_sim in lines)


def test_a_package_that_is_needed_and_blocked_is_noticed() -> None:
    done = estimate_without("numpy", "mc")
    assert done.returncode != 0
    assert "'scipy' (blocked)" in done.stderr


def run_without_posix(*words: str | Path) -> str:
    """Return what the script prints that has no POSIX."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).with_name("without_posix.py")), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)
    assert done.returncode in (0, 3), done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_run_with_a_journal_needs_no_posix(tmp_path: Path) -> None:
    assert run_without_posix(tmp_path).splitlines() == ["True True"]


@pytest.mark.slow
def test_the_command_line_needs_no_posix(tmp_path: Path) -> None:
    words = ("estimate", "rare_envs/CarFollowing-v0", "--method", "mc", "--max-sim", "500", "--out", "run")
    assert "P[f <= 0]" in run_without_posix(tmp_path, *words)
    assert (tmp_path / "run" / "result.json").is_file()


@pytest.mark.parametrize("library", ["matplotlib", "pyarrow", "pandas", "cvxpy"])
def test_each_optional_library_is_named_with_what_installs_it(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    result = samplers.estimate(samplers.FunctionProblem(lambda u: u[:, 0], 1), "mc", seed=0, max_sim=10)
    use = {
        "matplotlib": result.plot,
        "pyarrow": result.to_arrow,
        "pandas": result.to_pandas,
        "cvxpy": lambda: project_mean(np.ones(2), np.zeros(2), np.array([[1.0, 0.0], [0.9, 0.4]]), 0.5),
    }[library]
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf"^.+ needs {library}: pip install {library}\.$"):
        use()
