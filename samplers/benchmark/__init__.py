"""Benchmark of samplers: problems with known probabilities, runs of any method on them, and what the runs show.

On the command line: `rare-envs bench samplers`.
"""

from samplers.benchmark.analytic_states import LimitState
from samplers.benchmark.catalogue import PROBLEMS, BenchmarkProblem
from samplers.benchmark.faults import find_faults
from samplers.benchmark.public_states import PUBLIC_STATES, PublicState
from samplers.benchmark.runs import Job, MethodRun, run_all, run_once
from samplers.benchmark.summary import Cell, cells_of, power_of

__all__ = [
    "PROBLEMS",
    "PUBLIC_STATES",
    "BenchmarkProblem",
    "Cell",
    "Job",
    "LimitState",
    "MethodRun",
    "PublicState",
    "cells_of",
    "find_faults",
    "power_of",
    "run_all",
    "run_once",
]
