from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import rare_envs
from rare_envs.study.arguments import Question
from rare_envs.study.evaluate import run
from rare_envs.study.plots import (
    MOMENTS,
    draw_convergence,
    draw_drive,
    explain_no_failure,
    save_plot,
)
from rare_envs.study.question import prepare
from rare_envs.study.replay import drive_again

FOLLOWING = "rare_envs/CarFollowing-v0"

pytestmark = pytest.mark.usefixtures("full_pictures")


@pytest.mark.parametrize("env_id", ["rare_envs/CutIn-v0", "rare_envs/HardBrake-v0"])
def test_the_legend_says_which_vehicle_is_which(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id, horizon=3.0)
    axes = list(Figure().subplots(MOMENTS + 1))
    draw_drive(axes, drive_again(problem, problem.base.sample(1, np.random.default_rng(0))[0]))
    legend = axes[-1].get_legend()
    assert legend is not None
    speeds = [f"speed of {label}" for label in problem.world.scenario.labels]
    assert [text.get_text() for text in legend.get_texts()] == [*speeds, "gap to the vehicle ahead"]


def test_a_run_without_a_failure_shows_how_its_bound_falls(tmp_path: Path) -> None:
    report = run(prepare(Question(env_id=FOLLOWING, base="i24", ego="idm", max_sim=200, method="mc")))
    high = report.estimate.interval[1]
    assert (report.estimate.p, report.estimate.n_sim) == (0.0, 200)
    axes = Figure().subplots()
    draw_convergence(axes, report.to_dict())
    spent, bound = next(line for line in axes.get_lines() if "without a failure" in str(line.get_label())).get_data()
    np.testing.assert_allclose([spent[0], bound[0], spent[-1], bound[-1]], [1.0, 1.0, 200.0, high], rtol=1e-6)
    np.testing.assert_allclose(bound[bound < 1.0] * spent[bound < 1.0], 200.0 * high, rtol=1e-6)
    words = explain_no_failure(report)
    assert "None of 200 simulations failed." in words
    assert f"below {high:.1e} (95 %)" in words
    save_plot(tmp_path / "plot.png", report)
    assert (tmp_path / "plot.png").stat().st_size > 20_000
