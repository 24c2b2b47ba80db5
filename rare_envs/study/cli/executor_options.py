"""Options of the commands that simulate: where that is done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from samplers import Executor

GIB = 2.0**30


class ExecutorKind(str, Enum):
    """Names of executors."""

    LOCAL = "local"
    RAY = "ray"


@dataclass(frozen=True, kw_only=True)
class ExecutorOptions:
    """Where simulations are made; none of these options changes the answer."""

    workers: Annotated[
        int | None, typer.Option(help="Processes that simulate; by default this one, or all cores of --executor.")
    ] = None
    executor: Annotated[
        ExecutorKind | None, typer.Option(help="Where they are: local processes, or the machines of a Ray cluster.")
    ] = None
    address: Annotated[
        str | None, typer.Option(help="Of the Ray cluster, or auto; by default one is started on this machine.")
    ] = None
    time_limit: Annotated[
        float | None, typer.Option(help="Seconds for a chunk of simulations, after which its worker counts as hung.")
    ] = None
    memory_limit: Annotated[
        float | None, typer.Option(help="GiB that the simulations of a worker process may take (Linux).")
    ] = None

    def fill(self, others: Mapping[str, Any], typed: set[str]) -> ExecutorOptions:
        """Return these options with those of a file in place of what was not typed.

        Args:
            others: Options of the file, by name.
            typed: Names of the options that were typed.

        Raises:
            ValueError: If the file names an executor that there is not.
        """
        values = {name: value for name, value in others.items() if name not in typed and value is not None}
        kinds = [kind.value for kind in ExecutorKind]
        if values.get("executor", kinds[0]) not in kinds:
            raise ValueError(
                f"In the file of --config: expected executor to be {' or '.join(kinds)}, got {values['executor']!r}."
            )
        if "executor" in values:
            values["executor"] = ExecutorKind(values["executor"])
        return replace(self, **values)

    def make(self) -> Executor | None:
        """Return the executor; None for this process.

        Raises:
            ValueError: If an option is out of range, or does not go with the executor.
        """
        import samplers

        settings = {"--address": self.address, "--time-limit": self.time_limit, "--memory-limit": self.memory_limit}
        given = [name for name, value in settings.items() if value is not None]
        if self.executor is None and self.workers is None:
            if given:
                raise ValueError(f"Expected {given[0]} together with --workers or --executor.")
            return None
        if self.address is not None and self.executor is not ExecutorKind.RAY:
            raise ValueError("--address does not go with --executor local.")
        if self.memory_limit is not None and not 0.0 < self.memory_limit < float("inf"):
            raise ValueError(f"Expected --memory-limit to be a number of GiB above 0, got {self.memory_limit}.")
        memory = None if self.memory_limit is None else self.memory_limit * GIB
        if self.executor is ExecutorKind.RAY:
            return samplers.RayCluster(self.address, self.workers, self.time_limit, memory_limit=memory)
        return samplers.LocalProcesses(self.workers, self.time_limit, memory)
