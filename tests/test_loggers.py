"""The recipes of docs/using_results.md for Weights & Biases and MLflow, against both libraries and doubles of them.

The libraries are no dependency of the project, so that the doubles, which take what the signatures of wandb 0.31 and
mlflow 3.17 take and refuse what these refuse, run everywhere.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterator, Mapping
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


def recipe(code: str, **modules: Any) -> dict[str, Any]:
    """Run a recipe of the page behind its helpers, with modules under their names, and return all names."""
    assert NUMBERS is not None
    problem = samplers.FunctionProblem(lambda x: 3.5 - x[:, 0], dim=4)
    space = {"samplers": samplers, "math": math, "problem": problem, **modules}
    without_import = re.sub(r"^import .*\n", "", code, flags=re.MULTILINE)
    for each in (NUMBERS[0], HELPERS, without_import):
        exec(each, space)
    return space


def assert_followed(points: list[tuple[int, float]], result: samplers.Estimate) -> None:
    """Assert that p was logged at growing numbers of simulations, at last near the answer."""
    steps = [step for step, _ in points]
    assert len(points) > 5
    assert steps == sorted(steps)
    assert steps[-1] <= result.n_sim
    assert points[-1][1] == pytest.approx(result.p, rel=0.5)


class RunDouble:
    """A run of wandb: takes mappings at steps that do not go back, as it does."""

    def __init__(self) -> None:
        self.logged: list[tuple[int, float]] = []
        self.summary: dict[str, Any] = {}

    def log(self, data: dict[str, Any], step: int | None = None, commit: bool | None = None) -> None:
        assert isinstance(data, Mapping)  # wandb raises TypeError
        assert all(isinstance(key, str) for key in data)
        assert isinstance(step, int)
        assert not self.logged or step >= self.logged[-1][0]  # wandb drops what goes back
        if "p" in data:
            self.logged.append((step, data["p"]))

    def __enter__(self) -> RunDouble:
        return self

    def __exit__(self, *error: object) -> None:
        pass


class WandbDouble:
    """The module wandb."""

    def __init__(self) -> None:
        self.run = RunDouble()

    def init(self, entity: str | None = None, project: str | None = None) -> RunDouble:
        assert isinstance(project, str)
        return self.run


class MlflowDouble:
    """The module mlflow: takes numbers alone, inside a run alone."""

    def __init__(self) -> None:
        self.logged: list[tuple[int, float]] = []
        self.files: dict[str, dict[str, Any]] = {}
        self.running = False

    @contextmanager
    def start_run(self) -> Iterator[None]:
        self.running = True
        yield
        self.running = False

    def log_metrics(self, metrics: dict[str, float], step: int | None = None, synchronous: bool | None = None) -> None:
        assert self.running
        assert isinstance(step, int)
        assert all(isinstance(value, int | float) and math.isfinite(value) for value in metrics.values())
        if "p" in metrics:
            self.logged.append((step, metrics["p"]))

    def log_dict(self, dictionary: dict[str, Any], artifact_file: str) -> None:
        assert self.running
        self.files[artifact_file] = dictionary


def test_a_run_of_wandb_follows_an_estimate() -> None:
    wandb = WandbDouble()
    result = recipe(WANDB, wandb=wandb)["result"]
    assert_followed(wandb.run.logged, result)
    assert wandb.run.summary == {"p": result.p, "low": result.interval[0], "high": result.interval[1]}


def test_a_run_of_mlflow_follows_an_estimate() -> None:
    mlflow = MlflowDouble()
    result = recipe(MLFLOW, mlflow=mlflow)["result"]
    assert_followed(mlflow.logged, result)
    assert mlflow.files["estimate.json"]["p"] == result.p


def test_wandb_itself_takes_it_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb", reason="wandb is no dependency of the project")
    for name, value in (("WANDB_MODE", "offline"), ("WANDB_SILENT", "true"), ("WANDB_DIR", str(tmp_path))):
        monkeypatch.setenv(name, value)
    result = recipe(WANDB, wandb=wandb)["result"]
    (stored,) = tmp_path.rglob("*.wandb")
    assert repr(result.interval[1]).encode() in stored.read_bytes()
    for double, real in ((RunDouble.log, wandb.Run.log), (WandbDouble.init, wandb.init)):
        assert set(inspect.signature(double).parameters) <= set(inspect.signature(real).parameters) | {"self"}


def test_mlflow_itself_takes_it_into_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow", reason="mlflow is no dependency of the project")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    before = mlflow.get_tracking_uri()
    mlflow.set_tracking_uri((tmp_path / "runs").as_uri())
    try:
        result = recipe(MLFLOW, mlflow=mlflow)["result"]
        client = mlflow.MlflowClient()
        run_id = mlflow.last_active_run().info.run_id
        points = [(each.step, each.value) for each in client.get_metric_history(run_id, "p")]
        assert_followed(points, result)
        assert [each.path for each in client.list_artifacts(run_id)] == ["estimate.json"]
    finally:
        mlflow.set_tracking_uri(before)
    for name in ("log_metrics", "log_dict", "start_run"):
        ours, real = inspect.signature(getattr(MlflowDouble, name)), inspect.signature(getattr(mlflow, name))
        assert set(ours.parameters) <= set(real.parameters) | {"self"}
