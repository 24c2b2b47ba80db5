"""Two commits in alternating pairs."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.simulation import compare_commits
from benchmarks.simulation.compare_commits import compare_trees, measure_command, work_trees

LOG = "import os, pathlib; pathlib.Path('../log').open('a').write(pathlib.Path.cwd().name)"


def test_pairs_alternate_and_the_first_is_not_counted(tmp_path: Path) -> None:
    trees = [tmp_path / "0", tmp_path / "1"]
    for tree in trees:
        tree.mkdir()
    times = compare_trees([sys.executable, "-c", LOG], trees, runs=3)
    assert (tmp_path / "log").read_text() == "10011001"
    assert [len(own) for own in times] == [3, 3]
    assert min(min(own) for own in times) > 0


def test_more_work_takes_more_processor_time(tmp_path: Path) -> None:
    sleeping, working = "import time; time.sleep(0.3)", "sum(i * i for i in range(6_000_000))"
    assert measure_command([sys.executable, "-c", working], tmp_path) > 1.5 * measure_command(
        [sys.executable, "-c", sleeping], tmp_path
    )


def test_a_command_that_fails_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ended with 1 in .*: ZeroDivisionError"):
        measure_command([sys.executable, "-c", "1 / 0"], tmp_path)


def test_work_trees_have_the_files_of_their_commits_and_go_again(tmp_path: Path, monkeypatch) -> None:
    def git(*arguments: str) -> None:
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True, capture_output=True)

    git("init", "-b", "main")
    for text in ("one", "two"):
        (tmp_path / "a.txt").write_text(text)
        git("add", "a.txt")
        git("-c", "user.name=a", "-c", "user.email=a@example.org", "commit", "-m", text)
    monkeypatch.setattr(compare_commits, "ROOT", tmp_path)
    with work_trees(["main~1", "main"]) as trees:
        assert [(tree / "a.txt").read_text() for tree in trees] == ["one", "two"]
    assert not any(tree.exists() for tree in trees)
    with pytest.raises(ValueError, match="Cannot check out 'nothing'"), work_trees(["main", "nothing"]):
        pass
    listed = subprocess.run(
        ["git", "-C", str(tmp_path), "worktree", "list"], capture_output=True, text=True, check=True
    )
    assert len(listed.stdout.splitlines()) == 1
