"""The calibration against people: what is counted, and which part is called off, on made-up counts."""

from typing import Any

import numpy as np
import pytest
import torch

import rare_envs
from benchmarks.driving import human_calibration as calibration
from benchmarks.driving.human_calibration import (
    DRIVERS,
    EVENTS,
    CalibrationCell,
    FullBraking,
    classify_outcomes,
    count_outcomes,
    count_per_event,
    format_measured,
    format_row,
    judge,
    split_draws,
)
from rare_envs.control.human_driver import MAX_HUMAN_BRAKING

CUT_IN = EVENTS[0]
CUT_INS = CUT_IN.find_frequency("us101")
KM_100CAR = 2e6 * 1.609344


def cells_of(**counts: tuple[int, int, int]) -> dict[str, CalibrationCell]:
    """Contacts, near-crashes and needed ones of the human driver and of full braking; the others like the human's."""
    best = counts.pop("best")
    found = {
        name: CalibrationCell(CUT_IN.name, name, "x", 100_000, *counts["human"], counts["human"][0] // 2)
        for name in DRIVERS
    }
    found["full braking at once"] = CalibrationCell(CUT_IN.name, "full braking at once", "x", 100_000, *best, 0)
    return found


def test_outcomes_are_those_of_the_measures_and_of_the_crashes() -> None:
    cell = count_outcomes(CUT_IN, "human", "us101", 1000, seed=3)
    around = rare_envs.DrivingProblem(CUT_IN.env_id, ego="human", measure="near_crash", base="us101")
    x = around.base.sample(1000, np.random.default_rng(3))
    f = around.evaluate(x)
    ttc = rare_envs.DrivingProblem(CUT_IN.env_id, ego="human", base="us101").evaluate(x)
    required = rare_envs.DrivingProblem(CUT_IN.env_id, ego="human", measure="required_deceleration", base="us101")
    near = (f <= 0.0) & (ttc > 0.0)
    assert cell.contacts == int((ttc <= 0.0).sum()) > 0
    assert cell.near_crashes == int(near.sum()) > 0
    assert cell.needed == int((near & (required.evaluate(x) <= 5.0 - 0.5 * 9.80665)).sum()) > 0
    assert cell.flanks == around.crash_kinds(x[ttc <= 0.0]).count("side") > 0


def test_outcomes_are_told_apart() -> None:
    """Nothing; braking beyond 0.5 g that was not needed, and that was; a contact."""
    near, required = torch.tensor([0.1, 0.0, -0.5, -100.0]), torch.tensor([4.0, 4.0, 0.0, -100.0])
    assert classify_outcomes(torch.stack([near, required])).tolist() == [0.0, 1.0, 2.0, 3.0]


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
    told = " ".join(judge(CUT_IN, CUT_INS, cells_of(human=human, best=best)))
    assert said in told
    assert unsaid not in told


def test_a_row_has_shares_with_intervals() -> None:
    some = CalibrationCell("cut-in", "human", "x", 1000, 10, 0, 0, 0)
    assert format_row(some).startswith("| human | 1.0e-02 (4.8e-03 to 1.8e-02) | under 3.7e-03 |")


def test_people_per_event_are_counts_over_events_in_as_many_km() -> None:
    """1 contact (exact Poisson interval 0.0253 to 5.572) in 2 million miles, with 1221 x 38 / 46 cut-ins in 3900 km."""
    per_km = 1221 * 38 / 46 / 3900
    low, high = count_per_event(CUT_IN.contacts, CUT_INS)
    assert (low, high) == pytest.approx((0.02532 / KM_100CAR / per_km, 5.572 / KM_100CAR / per_km), rel=1e-3)
    for events, counts in zip(EVENTS, ((1, 136), (14, 385)), strict=True):
        found = (events.contacts.per_million_km, events.near_crashes.per_million_km)
        assert found == pytest.approx([1e6 * count / KM_100CAR for count in counts])
    with pytest.raises(ValueError, match="no event frequency"):
        CUT_IN.find_frequency("highway")


def test_parts_and_page(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert split_draws(45_000) == [20_000, 20_000, 5_000]
    page = tmp_path / "page.md"
    page.write_text("# Text\n\n## Measured\n\nold\n")
    monkeypatch.setattr(calibration, "PAGE", page)
    cells = [CalibrationCell(e.name, d, "us101", 100, 1, 2, 1, 0) for e in EVENTS for d in DRIVERS]
    calibration.write_page(format_measured(cells, "command"))
    text = page.read_text()
    assert text.startswith("# Text\n\n## Measured\n\n`command`; 100 draws each")
    assert "old" not in text
    assert "| cut-in | 0.26 | 2,586 | 0.31 | 5,173 | 42 |" in text
