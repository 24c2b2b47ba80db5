"""Commands of `rare-envs` in processes that begin with everything imported, so that a test can kill many of them.

Most of the time of a short command is that of its imports. A server makes them once, and each command is a fork of it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    ["pyarrow.parquet", "sklearn.cluster", "torch", "rare_envs.study.cli.app", "rare_envs.study.evaluate"]
)
TILE = 50
"""Simulations of a chunk without workers."""
END_SECONDS = 300.0


class Ended(NamedTuple):
    """A command that has ended: its exit code, less than 0 for a signal, and what is on its streams."""

    code: int
    printed: str
    said: str


class ForkedCommand:
    """A command that runs in a folder, in a process of its own."""

    def __init__(self, folder: Path, *words: str, kill_at: int = 0, pause: float = 0.0) -> None:
        """Start it; it kills itself at the change of a file's name of number `kill_at`, from 1 on, and pauses [s] after
        each chunk."""
        self._outputs = [folder / "printed.txt", folder / "said.txt"]
        for path in self._outputs:
            path.write_text("")
        self._process = CONTEXT.Process(target=run_command, args=(folder, words, self._outputs, kill_at, pause))
        self._process.start()

    def wait_for_more(self, path: Path) -> None:
        """Wait until something is written to a journal, or the process has ended."""

        def last_write() -> int:
            found = (path, path.with_name(f"{path.name}-wal"))
            return max((each.stat().st_mtime_ns for each in found if each.exists()), default=0)

        before = last_write()
        deadline = time.monotonic() + END_SECONDS
        while self._process.is_alive() and time.monotonic() < deadline:
            if last_write() > before:
                return
            time.sleep(0.001)

    def kill(self) -> None:
        """Kill it, which it must not have come to its end before."""
        self._process.kill()
        ended = self.end()
        assert ended.code == -signal.SIGKILL, ended

    def end(self) -> Ended:
        """Wait for its end."""
        self._process.join(END_SECONDS)
        code = self._process.exitcode
        printed, said = (path.read_text() for path in self._outputs)
        if code is None:
            self._process.kill()
            raise AssertionError(f"The command does not end: {said}")
        return Ended(code, printed, said)


def run_command(folder: Path, words: tuple[str, ...], outputs: list[Path], kill_at: int, pause: float) -> None:
    """Run a command, without pictures, and exit with its code."""
    from rare_envs.problem import DrivingProblem
    from rare_envs.study import cli, writing
    from samplers.journal import Journal

    os.chdir(folder)
    for number, path in enumerate(outputs, 1):
        os.dup2(os.open(path, os.O_WRONLY), number)
    sys.argv = ["rare-envs", *words]
    DrivingProblem.tile = TILE
    writing.save_pictures = lambda path, report: None
    append = Journal.append
    Journal.append = lambda *words: (append(*words), time.sleep(pause))[0]  # type: ignore[method-assign]
    if kill_at:
        _kill_at_change(kill_at)
    cli.main()


def _kill_at_change(kill_at: int) -> None:
    """Kill this process before it replaces or removes a file for the n-th time, as the final writes do."""
    left = [kill_at]
    for name in ("replace", "unlink"):
        setattr(Path, name, _counted(getattr(Path, name), left))


def _counted(act: Callable[..., Any], left: list[int]) -> Callable[..., Any]:
    def count(*words: Any, **options: Any) -> Any:
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return act(*words, **options)

    return count
