"""`samplers` alone: it needs no torch, Stable-Baselines3, cvxpy or Gymnasium."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

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
