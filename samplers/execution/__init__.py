"""Execution: arguments of a run, the ask-tell dialogue, the evaluation log, replicates and faults."""

from samplers.execution.arguments import RunArguments
from samplers.execution.progress import Progress
from samplers.execution.run import Run

__all__ = ["Progress", "Run", "RunArguments"]
