"""Table of a risk by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from rare_envs.study import Question, prepare, run
from rare_envs.study.report import compute_rate
from rare_envs.study.risk import Risk, ScenarioRisk
from tests.rare_envs.study.fitted_files import write_fitted


@pytest.fixture
def brake(tmp_path: Path) -> ScenarioRisk:
    base = write_fitted(tmp_path / "base.json", "hard_brake")
    study = prepare(Question(env_id="rare_envs/HardBrake-v0", base=base, method="mc", max_sim=400))
    report = run(study)
    rate = compute_rate(study, report.estimate)
    return ScenarioRisk(report=report, rate=rate, site_factors={"i80": 0.125, "i24": 2.0}, notes=("a note",))


def test_the_line_of_a_scenario(brake: ScenarioRisk) -> None:
    p = brake.report.estimate.p
    line = brake.describe()
    assert line.startswith(f"hard brake    0.19 per km x {p:.1e} = ")
    assert "42 events of 40 scenes" in line
    assert line.endswith("under i80 0.12 times as much, under i24 2 times as much")


def test_kinds_of_crash_add_up_to_the_rate(brake: ScenarioRisk) -> None:
    assert brake.kinds == pytest.approx({"rear_end": 42 / 218 * 1e6 * brake.report.estimate.p})
    found = Risk(ego="idm", scenarios=(brake,))
    assert "(100 %)" in str(found)
    assert found.kinds == brake.kinds


@pytest.mark.usefixtures("full_pictures")
def test_notes_and_json(brake: ScenarioRisk, tmp_path: Path) -> None:
    found = Risk(ego="idm", scenarios=(brake,))
    assert found.notes == ("hard brake: a note",)
    assert str(found).endswith("note: hard brake: a note")
    data = found.to_dict()
    assert data["further_events"]["scenario"] == "hard_brake"
    assert data["scenarios"]["hard_brake"]["site_factors"] == {"i80": 0.125, "i24": 2.0}
    found.save_plot(tmp_path / "risk.png")
    assert (tmp_path / "risk.png").stat().st_size > 10_000
