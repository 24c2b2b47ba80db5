"""The installed command."""

from __future__ import annotations

import subprocess
import sys


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "rare_envs", *words], capture_output=True, text=True, check=False)


def test_the_installed_command_behaves_the_same() -> None:
    refused = run("estimate", "CutIn")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.count("\n") == 1
    alone = run()
    assert (alone.returncode, alone.stderr) == (0, "")
    assert all(word in alone.stdout for word in ("list", "estimate", "train-ego"))
