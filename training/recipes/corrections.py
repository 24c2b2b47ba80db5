"""Corrections of an ego where it failed: searches for failures, half of which are held out, and labels to learn.

DAgger (Ross, Gordon and Bagnell, AISTATS 2011): the ego drives, an expert that sees the true state says what was right,
and the network learns that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import rare_envs
import samplers


class Search(NamedTuple):
    """A search for failures of an ego."""

    record: dict[str, Any]
    """Scenario, base, p of the ego and how many failures were found."""
    driven: NDArray[np.float64]
    """Failures to learn from, shape (n, d)."""
    held_out: NDArray[np.float64]
    """The others."""


def search_failures(ego: Any, env_id: str, base: str, rng: np.random.Generator, **options: Any) -> Search:
    """Return the failures of an ego that `samplers.estimate` finds with some options."""
    problem = rare_envs.DrivingProblem(env_id, ego=ego, base=base)
    estimate = samplers.estimate(problem, samplers.TwoStage(), **options)
    x = rng.permutation(np.asarray(estimate.failures.x))
    return Search({"env_id": env_id, "base": base, "p": estimate.p, "found": len(x)}, x[::2], x[1::2])


def count_failing(search: Search, ego: Any) -> dict[str, Any]:
    """Return the record of a search, with how many of its failures a corrected ego still fails in."""
    problem, record = rare_envs.DrivingProblem(search.record["env_id"], ego=ego), dict(search.record)
    for name, x in (("driven", search.driven), ("held_out", search.held_out)):
        record |= {name: len(x), f"{name}_failing": int((problem.evaluate(x) <= 0.0).sum()) if len(x) else 0}
    return record


def learn(
    parameters: list[torch.nn.Parameter], loss: Callable[[], Tensor], steps: int, rate: float, clip: float = math.inf
) -> None:
    """Make steps of Adam down a loss of drawn moments, at a rate that falls to zero as a cosine."""
    optimiser = torch.optim.Adam(parameters, rate)
    for step in range(steps):
        descend(optimiser, loss(), rate * (0.5 + 0.5 * math.cos(math.pi * step / steps)), clip)


def descend(optimiser: torch.optim.Optimizer, loss: Tensor, rate: float, clip: float = math.inf) -> None:
    """Make one step down a loss at a rate, with a gradient of at most some norm."""
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.zero_grad()
    torch.autograd.backward(loss)
    if clip < math.inf:
        torch.nn.utils.clip_grad_norm_([p for group in optimiser.param_groups for p in group["params"]], clip)
    optimiser.step()
