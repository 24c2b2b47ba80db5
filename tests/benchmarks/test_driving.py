"""Egos, the calibration against people and retraining: what is counted, kept and held out, on made-up counts."""

import numpy as np
import pytest

import rare_envs
import samplers
from benchmarks.driving import egos
from benchmarks.driving.egos import evaluate_ego, read_results, write_results
from benchmarks.driving.human_calibration import (
    DRIVERS,
    EVENTS,
    CalibrationCell,
    FullBraking,
    count_outcomes,
    count_per_event,
    judge,
)
from benchmarks.training import retraining
from benchmarks.training.retraining import RetrainingRound, compare_arms, draw_rounds, format_rounds, run_arm
from rare_envs.control.human_driver import MAX_HUMAN_BRAKING


def test_an_ego_is_measured_and_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(egos, "EGOS_RESULT", tmp_path / "egos.json")
    assert read_results() == {}
    cell = evaluate_ego("rare_envs/CarFollowing-v0", "idm", "two-stage", 10, tmp_path, at_most=1000)
    assert (cell.words.partition(",")[0], cell.steps) == ("rear_end", 0)
    assert 0 < cell.low < cell.p < cell.high and cell.n_sim <= 1000
    write_results({(cell.env_id, cell.ego, cell.method): cell})
    assert read_results() == {("rare_envs/CarFollowing-v0", "idm", "two-stage"): cell}


CUT_IN = EVENTS[0]
CUT_INS = CUT_IN.find_frequency("us101")
KM_100CAR = 2e6 * 1.609344


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


def test_full_braking_stops_in_the_way_of_physics() -> None:
    """From 15 m/s behind a lead that stands: v^2 / (2 b) = 14.82 m, and half a tick's way more at most."""
    way = 15.0**2 / (2 * MAX_HUMAN_BRAKING)
    around = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=FullBraking())
    f = around.evaluate(np.array([[15.0, 0.0, way + 0.8], [15.0, 0.0, way - 0.1]]))
    assert f[0] > 0.0 > f[1]


def test_the_part_that_is_off_is_named() -> None:
    """Contacts, near-crashes and needed ones of the human driver and of full braking; the others are like the human."""
    for human, best, said, unsaid in (
        ((0, 20, 20), (0, 100_000, 5), "agrees", "Distribution"),
        ((1000, 30_000, 3000), (0, 100_000, 100), "Distribution: off", "agrees"),
        ((1000, 30_000, 3000), (0, 100_000, 10), "Distribution: not shown to be off", "agrees"),
        ((1000, 30_000, 3000), (90, 99_910, 0), "Distribution: off", "agrees"),
    ):
        counts = {name: (*human, human[0] // 2) for name in DRIVERS} | {"full braking at once": (*best, 0)}
        cells = {name: CalibrationCell(CUT_IN.name, name, "x", 100_000, *each) for name, each in counts.items()}
        told = " ".join(judge(CUT_IN, CUT_INS, cells))
        assert said in told and unsaid not in told


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


def make_round(seed=0, arm="failures", number=0, p=1e-3, **more):
    values = {"found": (p, p / 2, 2 * p), "held_out": (p, p / 2, 2 * p), "counted": (0.0, 0.0, 2e-4)}
    return RetrainingRound(
        seed, arm, number, **values, **{"simulations": 12_000, "found_failures": 1000, "held_out_failures": 900, **more}
    )


@pytest.mark.parametrize("arm", ["failures", "ordinary"])
def test_the_failures_of_all_rounds_are_trained_on_and_the_others_held_out(arm, tmp_path, monkeypatch):
    """Egos that are never trained: the scenarios that a training would get are looked at."""
    given = []

    def train(env_id, algo, steps, seed, out, retraining=None):
        given.append(None if retraining is None else retraining.failures)
        out.write_text("")
        return out

    problem = samplers.FunctionProblem(lambda u: 2.5 - u.sum(axis=1) / 6**0.5, dim=6)
    monkeypatch.setattr(retraining, "make_problem", lambda ego: problem)
    monkeypatch.setattr(retraining, "train_ego", train)
    rounds = list(run_arm(0, arm, tmp_path, rounds=2, first=10, more=10, simulations=700, counted=50))
    assert [one.round for one in rounds] == [0, 1, 2]
    assert [one.still_failing for one in rounds] == [(1.0, 1.0), (1.0, 1.0), None]  # the same ego in each round
    assert given[0] is None
    assert all(0 < one.found[0] < 0.02 and one.held_out != one.found for one in rounds)
    if arm == "ordinary":
        assert [len(x) for x in given[1:]] == [1000, 1000]
        assert not np.array_equal(given[1], given[2])
    else:
        assert [len(x) for x in given[1:]] == [rounds[0].found_failures, sum(one.found_failures for one in rounds[:2])]
        assert (problem.evaluate(given[2]) <= 0.0).all()


def test_the_table_and_the_ratio_of_the_arms(tmp_path):
    rounds = [
        make_round(0, "failures", 1, 1e-4, still_failing=(0.25, 0.5)),
        make_round(0, "ordinary", 1, 4e-4, still_failing=(0.5, 0.5)),
        make_round(1, "failures", 1, 1e-4, still_failing=None),
        make_round(1, "ordinary", 1, 1e-4, still_failing=None),
    ]
    middle, low, high = compare_arms(rounds, 1)
    half = 12.706204736 * np.log(2.0)  # Student's quantile of one degree of freedom; the logs are 0 and -log 4
    assert (middle, low, high) == pytest.approx((0.5, 0.5 * np.exp(-half), 0.5 * np.exp(half)))
    assert "| 0 | failures | 1 | 1.0e-04 (5.0e-05 to 2.0e-04) |" in format_rounds(rounds)
    assert "| 1,000, 900 | 0.250, 0.500 |" in format_rounds(rounds)
    draw_rounds(rounds, tmp_path / "retraining.png")
    assert (tmp_path / "retraining.png").stat().st_size > 5_000
