"""Runs of a study in a file, each a line of JSON, so that the study goes on where it has ended."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from rich.console import Console
from rich.progress import track

from rare_envs.files import replace_text
from rare_envs.study.arguments import BadInput

_Run = TypeVar("_Run")
_Job = TypeVar("_Job")

_NOT_IN_JSON = {repr(value): value for value in (math.nan, math.inf, -math.inf)}


@dataclass(frozen=True)
class RunLines(Generic[_Job, _Run]):
    """A file with a line that says what its runs belong to, then one line for each run.

    A run whose line a stop has cut off is made again.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     lines = RunLines(Path(folder) / "runs.jsonl", {"version": 1}, parse=dict, encode=dict,
        ...                      key_of_job=str, key_of_run=lambda run: run["key"])
        ...     make = lambda jobs: ({"key": job, "value": 2.0 * int(job)} for job in jobs)
        ...     first = lines.complete(["1", "2"], make)
        ...     [run["value"] for run in lines.complete(["1", "2", "3"], make)], len(lines.read())
        ([2.0, 4.0, 6.0], 3)
    """

    file: Path
    header: Mapping[str, Any]
    """What all runs of the file have in common, such as the version of the package and the scale."""
    parse: Callable[[dict[str, Any]], _Run]
    """Makes a run from the content of its line; raises ValueError, KeyError or TypeError where that is none."""
    encode: Callable[[_Run], Mapping[str, Any]]
    """Returns the content of the line of a run; numbers that JSON has not, at its top level, become texts."""
    key_of_job: Callable[[_Job], Hashable]
    key_of_run: Callable[[_Run], Hashable]
    """Equal for a job and the run that was made for it."""

    def read(self) -> list[_Run]:
        """Return the runs of the file, none if there is no such file.

        Raises:
            BadInput: It is damaged, or its runs belong to something else.
        """
        if not self.file.is_file():
            return []
        runs: list[_Run] = []
        found: Mapping[str, Any] = self.header
        for number, line in enumerate(self.file.read_text(encoding="utf-8").splitlines(), 1):
            try:
                content = json.loads(line)
                if number == 1:
                    found = {name: content[name] for name in self.header}
                    continue
                runs.append(self.parse({name: _decode(value) for name, value in content.items()}))
            except (AttributeError, ValueError, KeyError, TypeError) as error:
                raise BadInput(
                    f"{self.file}, line {number} is no run of this command; take the line out. {error}"
                ) from None
        for name, value in self.header.items():
            if found[name] != value:
                raise BadInput(f"{self.file} has runs of {name} {found[name]}, this is {value}: choose another --out.")
        return runs

    def complete(
        self,
        jobs: Sequence[_Job],
        make: Callable[[list[_Job]], Iterable[_Run]],
        progress: bool = False,
        description: str = "runs",
    ) -> list[_Run]:
        """Make the runs that the file does not have, write each when it is there, and return all that are wanted.

        `make` makes the runs of some jobs, in their order; a bar on standard error has the description before it.
        Raises BadInput as `read` does.
        """
        drop_torn_line(self.file)
        begun = self.file.is_file() and self.file.stat().st_size > 0
        done = {self.key_of_run(run): run for run in self.read()}
        missing = [job for job in jobs if self.key_of_job(job) not in done]
        made = iter(make(missing)) if missing else iter(())
        console = Console(stderr=True)
        with self.file.open("a", encoding="utf-8") as lines:
            if not begun:
                lines.write(json.dumps(dict(self.header)) + "\n")
            for run in track(made, description, len(missing), console=console, disable=not progress):
                done[self.key_of_run(run)] = run
                content = {name: _encode(value) for name, value in self.encode(run).items()}
                lines.write(json.dumps(content, allow_nan=False) + "\n")
                lines.flush()
        return [done[self.key_of_job(job)] for job in jobs]


def drop_torn_line(file: Path) -> None:
    """Take out a last line that a stop has cut off."""
    if file.is_file():
        text = file.read_text(encoding="utf-8")
        if text and not text.endswith("\n"):
            replace_text(file, text[: text.rfind("\n") + 1])


def _encode(value: Any) -> Any:
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value


def _decode(value: Any) -> Any:
    return _NOT_IN_JSON.get(value, value) if isinstance(value, str) else value
