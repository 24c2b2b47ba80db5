"""Tables of the paper beside made-up figures of ours."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.papers.okelly2018.scales import PRINTED_SEARCH, THRESHOLDS
from benchmarks.papers.okelly2018.tables import explain_differences, make_tables

GAMMAS = THRESHOLDS["lidar"]
NOT_RUN = {"iterations": 2, "of": 20, "weights_move": True, "estimates": [], "comparisons": []}
ESTIMATE = {"n": 1000, "events": 10, "p": 0.01, "standard_error": 0.003, "interval": None}
COMPARISON = {
    "events_ratio": 5.0,
    "events_interval": (3.0, 8.0),
    "variance_ratio": 7.2,
    "all_in": 1.2,
    "error_ratio": None,
    "errors_off": -5.0,
}
RUN = {
    **NOT_RUN,
    "iterations": 20,
    "search": 20_000,
    "sampler": {"shift": 5.0},
    "mean_ratio": 1e-9,
    "estimates": [ESTIMATE] * 4,
    "comparisons": [COMPARISON] * 4,
}


def found_of(search: dict[str, Any], own: tuple[dict[str, Any], ...] = ()) -> dict[str, Any]:
    return {"naive": [ESTIMATE] * 4, "naive_equal": [], "searches": {PRINTED_SEARCH: search}, "own": own}


def test_ours_stand_beside_theirs() -> None:
    values = make_tables("lidar", GAMMAS, found_of(RUN))[0].to_dict()["values"]
    rollouts, first, *_ = (value for value in values if value["labels"][0].startswith("naive, 1,000 rollouts"))
    assert (rollouts["quantity"], rollouts["paper"], rollouts["ours"]) == ("rollouts", 1_300_000, 1000)
    assert (first["paper"], first["ours"], first["quantity"]) == (12.4e-6, 0.01, "p (10 events)")
    assert first["labels"][1] == f"0.14 / {GAMMAS[0]}"
    assert first["interval"] == pytest.approx((0.00412, 0.01588))
    searched = [value["paper"] for value in values if PRINTED_SEARCH in value["labels"][0]]
    assert searched[:3] == [100_000, 19.8e-6, 8.88e-6]


def test_the_search_counts_for_the_paper_too() -> None:
    values = make_tables("lidar", GAMMAS, found_of(RUN))[1].values
    (ratio,) = (value for value in values[:3] if value.paper is not None)
    assert (ratio.paper, ratio.paper_all_in) == (pytest.approx(1.57, abs=0.01), pytest.approx(1.57 / 6, abs=0.01))
    assert (ratio.ours, ratio.ours_all_in) == (7.2, 1.2)
    assert (values[2].ours, values[2].ours_all_in, values[2].reasons) == (None, None, ("underflow",))
    estimates = make_tables("lidar", GAMMAS, found_of(RUN))[0].values
    (rollouts,) = (each for each in estimates if each.quantity == "rollouts" and PRINTED_SEARCH in each.labels[0])
    assert (rollouts.paper, rollouts.paper_all_in) == (100_000, 600_000)
    assert (rollouts.ours, rollouts.ours_all_in) == (1000, 21_000)


def test_what_was_not_run_has_no_number() -> None:
    for table in make_tables("lidar", GAMMAS, found_of(NOT_RUN)):
        rows = [value for value in table.values if PRINTED_SEARCH in value.labels[0]]
        assert rows
        assert all(value.ours is None and value.reasons == ("not run",) for value in rows)
    assert "2 of 20 iterations" in rows[0].labels[0]
    assert "weights" not in explain_differences("lidar", found_of(NOT_RUN))


def test_our_own_method_stands_at_its_threshold() -> None:
    own = {"gamma": GAMMAS[2], "n_sim": 3000, "p": 1e-3, "low": 8e-4, "high": 1.2e-3, "cov": 0.1, "gain": 30.0}
    estimates, ratios = make_tables("lidar", GAMMAS, found_of(RUN, (own,)))
    assert estimates.values[-2].labels[1] == f"0.19 / {GAMMAS[2]}"
    assert estimates.values[-1].ours == pytest.approx(1e-4)
    assert ratios.values[-1].ours_all_in == 30.0
    assert [value.ours_all_in for value in estimates.values[-3:]] == [3000, None, None]


@pytest.mark.parametrize("ego", ["lidar", "vision"])
def test_every_reason_is_explained(ego: str) -> None:
    make_tables(ego, THRESHOLDS[ego], found_of(RUN))  # it would be refused
    assert "1e-09" in explain_differences("lidar", found_of(RUN))["weights"]


def test_a_standard_error_that_underflows_is_no_gain() -> None:
    run = {**RUN, "comparisons": [{**COMPARISON, "variance_ratio": None, "all_in": None}] * 4}
    values = make_tables("lidar", GAMMAS, found_of(run))[1].values
    assert values[1].reasons == ("underflow",)


def test_a_standard_error_of_zero_gives_no_interval() -> None:
    run = {**RUN, "estimates": [{**ESTIMATE, "p": 1e-300, "standard_error": 0.0}] * 4}
    values = make_tables("lidar", GAMMAS, found_of(run))[0].values
    assert [each.interval for each in values if each.quantity == "p (10 events)"][4:] == [None] * 4


def test_rows_with_as_many_rollouts_as_the_paper_differ_by_chance() -> None:
    few, full = ({**found_of(RUN), "naive": [{**ESTIMATE, "n": n}] * 4} for n in (80_000, 1_300_000))
    assert "with fewer rollouts than theirs" in explain_differences("lidar", few)["scale"]
    assert "of as many rollouts as theirs" in explain_differences("lidar", full)["scale"]


def test_missed_failures_are_said_to_be_missed() -> None:
    alone = {**RUN, "weights_move": False}
    values = make_tables("lidar", GAMMAS, found_of(alone))[1].values
    assert all("missed" in value.reasons for value in values[:2])
    assert (values[3].ours, values[3].paper) == (-5.0, pytest.approx(0.79, abs=0.01))  # (19.8 - 12.4) / 9.4


def test_estimates_that_rest_on_few_draws_are_said_to() -> None:
    events = {**ESTIMATE, "n": 100_000, "events": 48_605}
    estimates = [{**events, "ess": ess} for ess in (2764.0, 82.0, None, 973.0)]
    alone = {**RUN, "weights_move": False, "estimates": estimates}
    values = make_tables("lidar", GAMMAS, found_of(alone))[1].values
    gains = [value for value in values if value.quantity == "variance, naive / sampler, equal draws"]
    assert ["few draws" in value.reasons for value in gains] == [False, True, False, False]


def test_only_reasons_in_use_are_explained() -> None:
    estimates, ratios = make_tables("lidar", GAMMAS, found_of(RUN))
    assert list(estimates.explanations) == ["thresholds", "scale", "search", "not run", "weights"]
    assert list(ratios.explanations) == ["thresholds", "scale", "search", "underflow", "weights"]


def test_what_the_paper_has_not_and_was_not_run_is_one_line() -> None:
    name = "starts alone, rho 0.1"
    found = found_of(RUN) | {"searches": {PRINTED_SEARCH: RUN, name: {**NOT_RUN, "weights_move": False}}}
    for table in make_tables("lidar", GAMMAS, found):
        (line,) = (value for value in table.values if name in value.labels[0])
        assert line.labels == (f"cross-entropy, {name}: not run", "all")
