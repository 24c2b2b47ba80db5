"""The recipes of docs/using_results.md for Weights & Biases and MLflow, against doubles of them.

The libraries are no dependency of the project, so that the doubles, which take what the signatures of wandb 0.31 and
mlflow 3.17 take and refuse what these refuse, run everywhere.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import samplers

PAGE = (Path(__file__).parents[1] / "docs/using_results.md").read_text(encoding="utf-8")
HELPERS, WANDB, MLFLOW = (
    next(code for code in re.findall(r"^```\w*\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL) if name in code)
    for name in ("def to_wandb(", "wandb.init(", "mlflow.start_run(")
)
NUMBERS = re.search(r"^def numbers\(.*?\n\n", PAGE, re.MULTILINE | re.DOTALL)


class Double:
    """A module, and a run of it: takes metrics at steps that do not go back, inside a run alone."""

    def __init__(self) -> None:
        self.logged: list[tuple[int, float]] = []
        self.summary: dict[str, Any] = {}
        self.files: dict[str, dict[str, Any]] = {}
        self.running = False

    def take(self, metrics: dict[str, Any], step: int | None) -> None:
        assert self.running and isinstance(metrics, dict) and isinstance(step, int)
        assert not self.logged or step >= self.logged[-1][0]  # wandb drops what goes back
        assert all(isinstance(value, int | float) and math.isfinite(value) for value in metrics.values())
        if "p" in metrics:
            self.logged.append((step, metrics["p"]))

    @contextmanager
    def begin(self) -> Iterator[Double]:
        self.running = True
        yield self
        self.running = False

    def init(self, entity: str | None = None, project: str | None = None) -> Any:
        return self.begin()

    def log(self, data: dict[str, Any], step: int | None = None, commit: bool | None = None) -> None:
        self.take(data, step)

    def start_run(self) -> Any:
        return self.begin()

    def log_metrics(self, metrics: dict[str, float], step: int | None = None, synchronous: bool | None = None) -> None:
        self.take(metrics, step)

    def log_dict(self, dictionary: dict[str, Any], artifact_file: str) -> None:
        assert self.running
        self.files[artifact_file] = dictionary


@pytest.mark.parametrize(("name", "code"), [("wandb", WANDB), ("mlflow", MLFLOW)])
def test_a_run_follows_an_estimate(name: str, code: str) -> None:
    """The recipe is run behind its helpers; p comes at growing numbers of simulations, at last near the answer."""
    assert NUMBERS is not None
    problem, double = samplers.FunctionProblem(lambda x: 3.5 - x[:, 0], dim=4), Double()
    space: dict[str, Any] = {"samplers": samplers, "math": math, "problem": problem, name: double}
    for each in (NUMBERS[0], HELPERS, re.sub(r"^import .*\n", "", code, flags=re.MULTILINE)):
        exec(each, space)
    result = space["result"]
    assert len(double.logged) > 5 and double.logged[-1][0] <= result.n_sim
    assert double.logged[-1][1] == pytest.approx(result.p, rel=0.5)
    if name == "wandb":
        assert double.summary == {"p": result.p, "low": result.interval[0], "high": result.interval[1]}
    else:
        assert double.files["estimate.json"]["p"] == result.p
