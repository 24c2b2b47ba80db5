"""Files that a run names are known by their content, wherever they lie."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from rare_envs.study.arguments import Question
from rare_envs.study.journal import digest_files, find_changed_files
from tests.rare_envs.study.refusals import SMALL, Cli, assert_refused


@pytest.fixture
def moved(cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a project that has moved, with a base and a run that names it by its path."""
    project = here / "project"
    project.mkdir()
    shutil.copy(risky, project / "base.json")
    monkeypatch.chdir(project)
    result = cli(*SMALL, "--base", "base.json", "--out", "runs/a")
    assert result.exit_code == 0, result.output
    monkeypatch.chdir(here)
    return project.rename(here / "elsewhere")


def test_a_file_that_moved_with_its_run_is_found(cli: Cli, moved: Path) -> None:
    result = cli("replay", moved / "runs/a", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["same"]


def test_a_file_that_moved_and_changed_is_refused(cli: Cli, moved: Path) -> None:
    with (moved / "base.json").open("a") as file:
        file.write(" ")
    assert_refused(cli("replay", moved / "runs/a"), "base.json", "has changed")


@pytest.mark.parametrize("name", ["vecnormalize.pkl", "mine.pkl"])
def test_statistics_of_an_ego_are_part_of_it(name: str, here: Path) -> None:
    (here / "ego.zip").write_bytes(b"weights")
    question = Question(env_id="", ego="noisy:ego.zip", stats="mine.pkl" if name == "mine.pkl" else None)
    bare = digest_files(question)
    (here / name).write_bytes(b"one")
    one = digest_files(question)
    (here / name).write_bytes(b"two")
    two = digest_files(question)
    assert find_changed_files(one, two) == find_changed_files(bare, one) == find_changed_files(one, bare) == [name]
