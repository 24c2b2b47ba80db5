"""Figures 2 and 3 from made-up curves."""

from matplotlib.figure import Figure

from rare_envs.study.reproduction.okelly2018.figures import (
    describe_figures,
    draw_ratios,
    list_thresholds,
    make_figures,
)

CURVE = [
    {"gamma": gamma, "events_ratio": 3.0, "variance_ratio": ratio}
    for gamma, ratio in ((0.4, None), (0.5, 1e40), (0.6, 2.0))
]


def test_both_ratios_stand_against_the_threshold() -> None:
    figures = describe_figures("lidar", {"searches": {"a": {"curve": CURVE}}})
    assert list(figures) == ["figure2a", "figure2b"]
    assert figures["figure2b"]["curves"]["a"] == {"gamma": [0.4, 0.5, 0.6], "ratio": [None, 1e40, 2.0]}


def test_what_the_paper_shows_is_a_sentence() -> None:
    found = {"searches": {}}
    said = [figure["paper"] for ego in ("lidar", "vision") for figure in describe_figures(ego, found).values()]
    assert said == ["3 to 10 times.", "2 to 16 times.", "up to 18 times.", "lower, no number is printed."]


def test_the_axes_are_the_papers() -> None:
    data = describe_figures("vision", {"searches": {"a": {"curve": CURVE}}})["figure3b"]
    figure = Figure()
    draw_ratios(figure, data)
    (axes,) = figure.axes
    assert axes.get_xlabel() == "threshold gamma [s]"
    assert axes.get_yscale() == "log"
    assert axes.lines[0].get_ydata().tolist() == [1e4, 2.0]


def test_a_figure_without_curves_says_so_and_is_not_drawn() -> None:
    figures = describe_figures("lidar", {"searches": {"a": {}}})
    assert "Not run yet" in figures["figure2a"]["caption"]
    assert make_figures({"figures": figures}) == []


def test_thresholds_begin_at_the_rarest() -> None:
    assert list_thresholds((0.39, 0.58))[0] == 0.39
