"""The calibration against people: what is counted, and which part is called off, on made-up counts."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import rare_envs
from benchmarks.driving import human_calibration as calibration
from benchmarks.driving.human_calibration import (
    DRIVERS,
    EVENTS,
    PEOPLE_PER_KM,
    CalibrationCell,
    FullBraking,
    count_outcomes,
    format_measured,
    format_row,
    judge,
    split_draws,
)
from rare_envs.control.human_driver import MAX_HUMAN_BRAKING

CUT_IN = EVENTS[0]


def cells_of(**counts: tuple[int, int, int]) -> dict[str, CalibrationCell]:
    """Contacts, near-crashes and needed ones of the human driver and of full braking; the others like the human's."""
    best = counts.pop("best")
    found = {
        name: CalibrationCell(CUT_IN.name, name, "x", 100_000, *counts["human"], counts["human"][0] // 2)
        for name in DRIVERS
    }
    found["full braking at once"] = CalibrationCell(CUT_IN.name, "full braking at once", "x", 100_000, *best, 0)
    return found


def test_outcomes_are_those_of_the_problem() -> None:
    cell = count_outcomes(CUT_IN, "human", CUT_IN.base, 300, seed=3)
    around = rare_envs.DrivingProblem(CUT_IN.env_id, ego="human", measure="near_crash", base=CUT_IN.base)
    x = around.base.sample(300, np.random.default_rng(3))
    f = around.evaluate(x)
    ttc = rare_envs.DrivingProblem(CUT_IN.env_id, ego="human").evaluate(x)
    assert cell.contacts == int((ttc <= 0.0).sum()) > 0
    assert cell.near_crashes == int((f <= 0.0).sum()) - cell.contacts > 0
    assert 0 < cell.needed < cell.near_crashes
    assert cell.flanks == around.crash_kinds(x[ttc <= 0.0]).count("side") > 0


def test_full_braking_stops_in_the_way_of_physics() -> None:
    """From 15 m/s behind a lead that stands: v^2 / (2 b) = 14.82 m, and half a tick's way more at most."""
    way = 15.0**2 / (2 * MAX_HUMAN_BRAKING)
    around = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=FullBraking())
    f = around.evaluate(np.array([[15.0, 0.0, way + 0.8], [15.0, 0.0, way - 0.1]]))
    assert f[0] > 0.0 > f[1]


@pytest.mark.parametrize(
    ("human", "best", "said", "unsaid"),
    [
        ((0, 20, 20), (0, 100_000, 5), "agrees", "Distribution"),
        ((1000, 30_000, 3000), (0, 100_000, 100), "Distribution: off", "agrees"),
        ((1000, 30_000, 3000), (0, 100_000, 10), "Distribution: not shown to be off", "agrees"),
        ((1000, 30_000, 3000), (90, 99_910, 0), "Distribution: off", "agrees"),
    ],
)
def test_the_part_that_is_off_is_named(human: Any, best: Any, said: str, unsaid: str) -> None:
    told = " ".join(judge(CUT_IN, cells_of(human=human, best=best)))
    assert said in told
    assert unsaid not in told


def test_shares_are_told_of_the_events_that_people_are_counted_by() -> None:
    some = CalibrationCell("cut-in", "human", "x", 1000, 10, 0, 0, 0)
    assert format_row(CUT_IN, some).startswith("| human | 1.0e-02 (4.8e-03 to 1.8e-02) | under 3.7e-03 |")
    assert "2.0e-03" in format_row(replace(CUT_IN, share=0.2), some)


def test_rates_of_people_are_those_of_the_study() -> None:
    """2 million miles; 1 and 136, 14 and 385 contacts and near-crashes."""
    km = 2e6 * 1.609344
    for name, counts in (("cut-in", (1, 136)), ("braking of the lead", (14, 385))):
        assert PEOPLE_PER_KM[name] == pytest.approx([count / km for count in counts], rel=0.03)
    brakings = EVENTS[1]
    assert brakings.contacts == pytest.approx((14 / km / 1.23, 14 / km / 0.155), rel=0.03)
    assert brakings.near_crashes == pytest.approx((385 / km / 1.23, 385 / km / 0.155), rel=0.03)


def test_parts_and_page(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert split_draws(45_000) == [20_000, 20_000, 5_000]
    page = tmp_path / "page.md"
    page.write_text("# Text\n\n## Measured\n\nold\n")
    monkeypatch.setattr(calibration, "PAGE", page)
    cells = [CalibrationCell(e.name, d, e.base, 100, 1, 2, 1, 0) for e in EVENTS for d in DRIVERS]
    calibration.write_page(format_measured(cells, "command"))
    text = page.read_text()
    assert text.startswith("# Text\n\n## Measured\n\n`command`; 100 draws each")
    assert "old" not in text
    assert "| cut-in | 0.26 | 2.6e-03 | 3.1e-07 |" in text
