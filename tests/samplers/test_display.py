"""Estimates and curves as text, HTML and pictures."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot

import samplers
from samplers.limit_states import half_space
from samplers.output import html_table

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


def test_given_axes_and_the_current_ones_are_used(result: samplers.Estimate) -> None:
    figure, given = pyplot.subplots()
    assert result.plot(given) is given
    assert result.plot(ax=None) is pyplot.gca()
    pyplot.close(figure)


@pytest.mark.parametrize("wrong", [3.0, np.zeros(2), b"p.png"])
def test_something_else_is_refused(wrong: object, result: samplers.Estimate) -> None:
    with pytest.raises(TypeError, match="Expected axes of matplotlib or the path of an image"):
        result.plot(wrong)  # type: ignore[arg-type]


def test_the_table_for_notebooks_has_warnings_last():
    few = samplers.estimate(half_space(2, 4.0).problem, "mc", seed=1, max_sim=100)
    text = few._repr_html_()
    assert "95 % interval" in text
    assert text.index("failing points") < text.index("warning: ")


def test_prints_warnings_and_no_gain_without_hits():
    never = samplers.FunctionProblem(lambda x: np.ones(len(x)), 1)
    text = str(samplers.estimate(never, "mc", seed=1, max_sim=100))
    assert "warning: None of 100 simulations failed" in text
    assert "gain" not in text
    assert "c.o.v. not known" in text


def test_remarks_are_printed_and_are_no_warnings():
    few = samplers.estimate(half_space(2, 1.0).problem, "two-stage", seed=1, max_sim=300)
    text = "max_sim leaves 300 simulations, too few for an exploration (400): base draws only."
    assert few.remarks == (text,)
    assert few.warnings == ()
    assert str(few).endswith(f"\n  remark: {text}")
    assert few.to_dict()["remarks"] == [text]


class Reader(HTMLParser):
    """Collect the texts of cells, and every element that was opened."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.texts.append(data)


def read(html):
    reader = Reader()
    reader.feed(html)
    return reader


def test_text_is_escaped_everywhere():
    evil = "<script>alert('x')</script>"
    found = read(html_table(evil, [(evil, evil)], [evil], [evil]))
    assert found.texts == [evil] * 5
    assert "script" not in found.tags
