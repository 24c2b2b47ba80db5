"""The installed command."""

from __future__ import annotations

import subprocess
import sys

import pytest


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "rare_envs", *words], capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_the_installed_command_behaves_the_same() -> None:
    refused = run("estimate", "CutIn")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.count("\n") == 1
    alone = run()
    assert (alone.returncode, alone.stderr) == (0, "")
    assert all(word in alone.stdout for word in ("list", "estimate", "train-ego"))


def test_the_command_line_starts_without_torch() -> None:
    code = "import sys, rare_envs.study.cli; print([name for name in ('torch', 'highway_env') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "[]\n", done.stderr
