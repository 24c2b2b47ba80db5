"""Runs in a process without what only POSIX has."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
SCRIPT = Path(__file__).with_name("without_posix.py")


def run_without_posix(*words: str | Path) -> str:
    """Return what the script prints that has no POSIX."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(SCRIPT), *map(str, words)]
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
