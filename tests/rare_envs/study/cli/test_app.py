"""The installed command."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "rare_envs", *words], capture_output=True, text=True, check=False)


def test_the_installed_command_behaves_the_same() -> None:
    refused = run("estimate", "CutIn")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.count("\n") == 1
    alone = run()
    assert (alone.returncode, alone.stderr) == (0, "")
    assert all(word in alone.stdout for word in ("list", "estimate", "train-ego"))


@pytest.mark.parametrize(
    ("words", "found"),
    [("rep", ["replay", "report", "reproduce"]), ("estimate rare_envs/Car", ["rare_envs/CarFollowing-v0"])],
)
def test_a_shell_completes_commands_and_environments(words: str, found: list[str]) -> None:
    asked = {
        "_RARE_ENVS_COMPLETE": "complete_bash",
        "COMP_WORDS": f"rare-envs {words}",
        "COMP_CWORD": str(len(words.split())),
    }
    command = [sys.executable, "-m", "rare_envs"]
    done = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, text=True, check=False)
    assert done.stdout.split() == found, done.stderr


def test_the_command_line_starts_without_torch() -> None:
    code = "import sys, rare_envs.study.cli; print([name for name in ('torch', 'highway_env') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "[]\n", done.stderr
