"""Functions of one point that fail in the ways in which simulations fail, on about 2 % of x."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import samplers

BAD = 2.0537
"""Phi(-BAD) = 0.02: x[1] above it is bad."""


def half_space(x: Any) -> float:
    """P[f <= 0] = Phi(-1) = 0.1587."""
    return float(1.0 - x[0])


def raising(x: Any) -> float:
    if x[1] > BAD:
        raise ArithmeticError("off the map")
    return half_space(x)


def nan(x: Any) -> float:
    return float("nan") if x[1] > BAD else half_space(x)


def hanging(x: Any) -> float:
    if x[1] > BAD:
        time.sleep(3600)
    return half_space(x)


def exiting(x: Any) -> float:
    if x[1] > BAD:
        sys.exit(3)
    return half_space(x)


def crashing(x: Any) -> float:
    if x[1] > BAD:
        os.kill(os.getpid(), signal.SIGSEGV)
    return half_space(x)


def hungry(x: Any) -> float:
    if x[1] > BAD:
        kept = [bytearray(1 << 28)]
        while True:
            kept.append(bytearray(1 << 28))
    return half_space(x)


FAULTS = {each.__name__: each for each in (raising, nan, hanging, exiting, crashing, hungry)}


class KillsItself:
    """A good f in a process that is killed at some calls, whichever points these have; it counts them in files."""

    def __init__(self, folder: Path, one_in: int) -> None:
        self.folder, self.one_in = folder, one_in

    def __call__(self, x: Any) -> float:
        number = len(list(self.folder.iterdir()))
        while True:  # each number once, whoever counts at the same time
            try:
                (self.folder / str(number)).touch(exist_ok=False)
                break
            except FileExistsError:
                number += 1
        if number % self.one_in == self.one_in - 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return half_space(x)


def problem(f: Any = half_space, chunk_size: int | None = None) -> samplers.FunctionProblem:
    return samplers.FunctionProblem(f, dim=3, vectorized=False, chunk_size=chunk_size)


def matrix(x: Any) -> Any:
    """An f whose bits depend on the rows of its batch: matrix products round differently by size."""
    weights = np.random.default_rng(0).standard_normal((3, 64)).astype(np.float32)
    hidden = np.tanh(x.astype(np.float32) @ weights)
    return 2.0 + (hidden @ weights.T[:, 0]) / 8.0
