from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rare_envs.study.html_report.figures import draw_curve, draw_parameters, draw_weights, figures_of_result

LEVEL = {"run": 0, "p": 0.1, "estimate": 0.1, "n_sim": 100, "cov": 0.3, "ess": None}
RESULT: dict[str, Any] = {
    "p": 0.01,
    "interval": [0.005, 0.02],
    "gamma": 0.0,
    "trace": [{**LEVEL, "gamma": 2.0}, {**LEVEL, "gamma": 0.0, "estimate": 0.01}],
}


def test_what_a_run_does_not_tell_has_no_figure() -> None:
    assert set(figures_of_result(RESULT, np.empty(0), "ttc [s]")) == {"convergence", "levels"}
    curve = {"gammas": [0.0, 1.0], "p": [0.01, 0.1], "low": [0.005, 0.05], "high": [0.02, 0.2], "confidence": 0.95}
    more = figures_of_result({**RESULT, "curve": curve}, np.log([0.004, 0.006]), "ttc [s]")
    assert set(more) == {"convergence", "levels", "weights", "curve"}
    assert all("<svg" in figure.to_svg() for figure in more.values())


def test_levels_without_a_probability_can_be_drawn() -> None:
    stopped = {**LEVEL, "gamma": None, "p": None, "estimate": None, "cov": None}
    for trace in ([], [stopped]):
        figures = figures_of_result({**RESULT, "p": 0.0, "interval": [0.0, 0.03], "trace": trace}, np.empty(0), "")
        assert all("<svg" in figure.to_svg() for figure in figures.values())


def test_the_heaviest_failures_add_up_to_all_of_p() -> None:
    figure = Figure()
    draw_weights(figure, np.log([0.001, 0.006, 0.003]), 0.01)
    line = figure.axes[1].lines[0]
    np.testing.assert_allclose(np.asarray(line.get_ydata()), [60.0, 90.0, 100.0])


def test_panels_stand_one_below_the_other_where_the_screen_is_narrow() -> None:
    side_by_side, stacked = Figure(), Figure()
    draw_weights(side_by_side, np.log([0.001, 0.006]), 0.007)
    draw_weights(stacked, np.log([0.001, 0.006]), 0.007, stacked=True)
    assert [axes.get_subplotspec().rowspan.start for axes in side_by_side.axes] == [0, 0]
    assert [axes.get_subplotspec().rowspan.start for axes in stacked.axes] == [0, 1]


def test_a_band_that_reaches_zero_stays_on_the_log_scale() -> None:
    figure = Figure()
    curve = {"gammas": [0.0, 1.0], "p": [0.01, 0.1], "low": [0.0, 0.05], "high": [0.02, 0.2], "confidence": 0.9}
    draw_curve(figure, curve, 0.0, "ttc [s]")
    assert figure.axes[0].get_ylim()[0] > 0 and figure.axes[0].get_xlabel() == "threshold of f, ttc [s]"


def test_a_parameter_of_one_value_can_be_drawn() -> None:
    figure = Figure()
    draw_parameters(figure, np.full((5, 1), 3.0), np.full((2, 1), 3.0), np.ones(2), ["gap [m]"])
    assert figure.axes[0].get_xlabel() == "gap [m]"
