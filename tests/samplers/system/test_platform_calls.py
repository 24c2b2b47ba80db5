"""Calls that differ by system: what they do here, and a run in a process without what only POSIX has."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from samplers.system import platform_calls
from samplers.system.platform_calls import end_process, lock_file, sync_folder

ROOT = Path(__file__).parents[3]
SCRIPT = Path(__file__).with_name("without_posix.py")
PLACES = {"samplers/system/platform_calls.py", "rare_envs/study/ego_check/checks.py"}
"""Modules that may import what one system alone has, and only where it is there."""


def run_without_posix(*words: str | Path) -> str:
    """Return what the script prints that has no POSIX."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(SCRIPT), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)
    assert done.returncode in (0, 3), done.stderr
    return done.stdout


def test_a_run_with_a_journal_and_workers_needs_no_posix(tmp_path: Path) -> None:
    assert run_without_posix(tmp_path).splitlines() == ["2 True True", "True"]


@pytest.mark.slow
def test_the_command_line_needs_no_posix(tmp_path: Path) -> None:
    words = ("estimate", "rare_envs/CarFollowing-v0", "--method", "mc", "--max-sim", "500", "--out", "run")
    assert "P[f <= 0]" in run_without_posix(tmp_path, *words)
    assert (tmp_path / "run" / "result.json").is_file()


def test_what_one_system_alone_has_is_imported_in_few_places() -> None:
    wanted = re.compile(
        r"^\s*(?:import|from) (?:fcntl|resource|pwd|grp|termios|msvcrt|winreg)\b|os\.fork\(", re.MULTILINE
    )
    found = {
        path.relative_to(ROOT).as_posix()
        for package in ("agents", "rare_envs", "samplers", "training")
        for path in (ROOT / package).rglob("*.py")
        if wanted.search(path.read_text(encoding="utf-8"))
    }
    assert found == PLACES


@pytest.mark.skipif(os.name != "posix", reason="a lock of this kind is of POSIX")
def test_a_file_is_locked_by_one_alone(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.touch()
    with path.open("r+b") as mine, path.open("r+b") as other:
        assert lock_file(mine)
        assert not lock_file(other)


def test_on_windows_a_byte_beyond_the_content_is_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Msvcrt:
        LK_NBLCK = 2
        taken = False

        @classmethod
        def locking(cls, descriptor: int, mode: int, n_bytes: int) -> None:
            assert (mode, n_bytes) == (2, 1)
            if cls.taken:
                raise PermissionError
            cls.taken = True

    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", Msvcrt)
    path = tmp_path / "file"
    path.touch()
    with path.open("r+b") as file:
        assert lock_file(file)
        assert file.tell() == platform_calls.BEYOND
        assert not lock_file(file)


def test_a_process_is_ended_where_there_are_no_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "killpg", raising=False)
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    end_process(child)
    assert child.wait(30) != 0
    end_process(child)  # once more does no harm
    assert child.stdin is not None
    child.stdin.close()


def test_a_folder_that_cannot_be_opened_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError

    sync_folder(tmp_path)
    monkeypatch.setattr(importlib.import_module("os"), "open", refuse)
    sync_folder(tmp_path)
