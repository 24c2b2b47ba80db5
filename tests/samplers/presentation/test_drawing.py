"""Where pictures are drawn: given axes, the current ones, or a file, for everything that has `plot`."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot

import samplers
from samplers.display import drawing_axes

matplotlib.use("Agg")
PNG, PDF = b"\x89PNG", b"%PDF"


@pytest.fixture(scope="module")
def result() -> samplers.Estimate:
    problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
    return samplers.estimate(problem, "mc", seed=0, max_sim=2000)


def test_a_path_is_written_and_leaves_no_figure_open(result: samplers.Estimate, tmp_path: Path) -> None:
    pyplot.close("all")
    axes = result.plot(tmp_path / "p.png")
    result.curve([0.0, 1.0]).plot(str(tmp_path / "curve.pdf"))
    assert axes.get_title() == f"P[f ≤ 0] = {result.p:.2e}"
    assert (tmp_path / "p.png").read_bytes().startswith(PNG)
    assert (tmp_path / "curve.pdf").read_bytes().startswith(PDF)
    assert pyplot.get_fignums() == []
    sensitivity = result.sensitivity(["a", "b"])
    assert len(sensitivity.plot(tmp_path / "sensitivity.png")) == 2
    assert (tmp_path / "sensitivity.png").read_bytes().startswith(PNG)


def test_a_comparison_is_written_too(tmp_path: Path) -> None:
    def problem(limit: float) -> samplers.FunctionProblem:
        return samplers.FunctionProblem(lambda x: limit - x[:, 0], dim=2)

    comparison = samplers.compare(problem(1.5), problem(1.8), "mc", seed=0, max_sim=2000)
    comparison.plot(tmp_path / "ratio.png")
    assert (tmp_path / "ratio.png").read_bytes().startswith(PNG)


def test_given_axes_and_the_current_ones_are_used(result: samplers.Estimate) -> None:
    figure, given = pyplot.subplots()
    assert result.plot(given) is given
    assert result.plot(ax=None) is pyplot.gca()
    pyplot.close(figure)


@pytest.mark.parametrize("wrong", [3.0, np.zeros(2), b"p.png"])
def test_something_else_is_refused(wrong: object, result: samplers.Estimate) -> None:
    with pytest.raises(TypeError, match="Expected axes of matplotlib or the path of an image"):
        result.plot(wrong)  # type: ignore[arg-type]


def test_nothing_is_written_where_drawing_fails(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), drawing_axes(tmp_path / "p.png"):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())
