"""Figures: their data and the paper's axes."""

from __future__ import annotations

import pytest

from rare_envs.study.reproduction.tian2024.figures import collect_figures, draw_figures
from rare_envs.study.reproduction.tian2024.replications import ReplicationJob
from tests.rare_envs.study.reproduction.tian2024.made_runs import made_run


@pytest.fixture(scope="module")
def figures():
    jobs = [
        ReplicationJob(scenario, "stack", method, seed, points=method == "SS" and scenario == "cut-in")
        for scenario in ("car-following", "cut-in")
        for method in ("MC", "IS", "SS", "ADSS")
        for seed in (5, 6)
    ]
    return collect_figures([made_run(job) for job in jobs])


def test_figure_6_is_the_first_replication_of_monte_carlo(figures) -> None:
    lines = figures["figure6"]["lines"]
    assert [(line["scenario"], line["system"]) for line in lines] == [("car-following", "stack"), ("cut-in", "stack")]
    assert lines[0]["n"] == [300_000]  # before, the threshold was another


def test_figure_7_has_v1_v2_and_dis1y_of_each_subset(figures) -> None:
    assert figures["figure7"]["levels"] == [[[30.0, 28.0, 3.7]] * 2, [[30.0, 24.0, 3.6]]]


def test_figure_8_has_every_replication_with_all_its_simulations(figures) -> None:
    assert figures["figure8"]["ends"]["ADSS"] == [[1850, 2.5e-4], [1850, 1.5e-4]]
    assert [line["method"] for line in figures["figure8"]["lines"]] == ["MC", "IS"]


def test_drawings_have_the_axes_of_the_paper(figures) -> None:
    svgs = {figure.name: figure.to_svg() for figure in draw_figures(figures)}
    assert list(svgs) == ["figure6", "figure7", "figure8"]
    assert "collision rate" in svgs["figure6"]
    assert "number of simulations" in svgs["figure8"]
    for label in ("v1 [m/s]", "v2 [m/s]", "dis1y [m]", "subset II"):
        assert label in svgs["figure7"]


def test_nothing_is_drawn_of_nothing() -> None:
    assert draw_figures(collect_figures([])) == []
