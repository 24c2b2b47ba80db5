"""Completion in a shell: the words it offers are those that the commands take, and the shells' scripts call it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rare_envs.scenarios.registry import SCENARIOS, scenario_named
from rare_envs.study.cli import completion
from rare_envs.study.cli.catalogue import list_names
from rare_envs.study.cli.catalogue_table import KINDS
from training.ego_training import HYPERPARAMETERS

ROOT = Path(__file__).parents[4]


def complete(line: str) -> list[str]:
    """Return what bash is offered for the last word of a line."""
    words = line.split(" ")
    asked = {"_RARE_ENVS_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    command = [sys.executable, "-m", "rare_envs"]
    done = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("rare-envs rep", ["replay", "report", "reproduce"]),
        ("rare-envs estimate --max", ["--max-sim", "--max-p"]),
        ("rare-envs estimate rare_envs/Car", ["rare_envs/CarFollowing-v0"]),
        ("rare-envs estimate CutIn-v0 --method ad", ["adss"]),
        ("rare-envs estimate CutIn-v0 --ego i", ["idm", "imitation"]),
        ("rare-envs estimate CutIn-v0 --base us101-c", ["us101-closing"]),
        ("rare-envs estimate NoSuch-v0 --base u", []),
        ("rare-envs compare idm mg", ["mgail", "mgail2", "mgail3", "mgail4", "mgail5"]),
        ("rare-envs train-ego Car", ["CarFollowing-v0"]),
        ("rare-envs train-ego CutIn-v0 --algo ", list(HYPERPARAMETERS)),
        ("rare-envs list me", ["methods", "measures"]),
        ("rare-envs bench samplers --method mc,ad", ["mc,adss"]),
    ],
)
def test_a_shell_completes_commands_options_and_names(line: str, found: list[str]) -> None:
    assert complete(line) == found


def test_words_written_out_are_those_of_the_catalogue() -> None:
    names = list_names()

    def small(keys: object) -> set[str]:
        words = (word for key in keys for word in str(key).split(", "))
        return {word for word in words if word == word.lower() and ":" not in word}

    assert set(completion.EGO_WORDS) == small(names["egos"])
    assert set(completion.DRIVER_WORDS) == small(names["drivers"])
    assert completion.MEASURE_WORDS == tuple(names["measures"])
    assert completion.LIST_WORDS == KINDS
    assert completion.complete_scenario("") == [
        *dict.fromkeys(name for name in ("car_following", "cut_in", "hard_brake", "highway") if scenario_named(name)),
        *completion.complete_environment(""),
    ]
    assert len(completion.complete_environment("")) == 2 * len(SCENARIOS)


SCRIPTS = {
    "bash": "COMP_WORDS=(rare-envs estimate CutIn-v0 --method ad) COMP_CWORD=4; _rare_envs_completion rare-envs; "
    'printf "%s" "${COMPREPLY[*]}"',
    "zsh": "words=(rare-envs estimate CutIn-v0 --method ad) CURRENT=5; _arguments() { print -rn -- $@ }; "
    "_describe() { print -rn -- $@ }; _rare_envs_completion",
    "fish": 'complete --do-complete "rare-envs estimate CutIn-v0 --method ad"',
}
"""What calls the completion of each shell, once its script is read."""


@pytest.mark.parametrize("shell", SCRIPTS)
def test_the_script_of_a_shell_calls_the_command(shell: str, tmp_path: Path) -> None:
    """In a home of its own, where `--install-completion` writes what the shell reads at its start."""
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not on this machine; bash is on all of them")
    command = tmp_path / "bin/rare-envs"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m rare_envs "$@"\n', encoding="utf-8")
    command.chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if name not in ("ZDOTDIR", "XDG_CONFIG_HOME")}
    environment |= {"HOME": str(tmp_path), "PATH": f"{command.parent}{os.pathsep}{os.environ['PATH']}"}
    environment |= {"PYTHONPATH": str(ROOT)}

    def run(code: str) -> str:
        done = subprocess.run([shell, "-c", code], env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "completion installed in" in run("rare-envs --install-completion; true")
    read = {
        "bash": "source ~/.bashrc; ",
        "zsh": "autoload -Uz compinit; compinit -u -d ~/.zcompdump; source ~/.zfunc/_rare-envs; ",
        "fish": "",
    }
    assert run(read[shell] + SCRIPTS[shell]).split()[-1].strip("'\"():") == "adss"
