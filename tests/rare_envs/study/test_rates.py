"""Rates against the formula by hand, sums over scenarios, other sites, and their text."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from scipy import stats

import rare_envs
import samplers
from rare_envs.distributions import CutNormals, EventCounts, EventFrequency, FittedDistribution, StratifiedDistribution
from rare_envs.distributions.stratified import Stratum
from rare_envs.exposure import CollisionRate
from rare_envs.people import EventRate, calibration, sum_people
from rare_envs.scenarios.hard_brake import HARD_BRAKE
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.simulation.observation import observation_space
from rare_envs.study import BadInput, Question, prepare, run
from rare_envs.study.compared_risks import RiskComparison
from rare_envs.study.report import describe_left_out, find_frequency, fold_spread, list_part_errors
from rare_envs.study.risk import compare_sites
from rare_envs.study.text import (
    describe_calibration,
    format_rate,
    format_with_interval,
    is_better_known,
    report_as_json,
    tabulate_events,
)
from tests.rare_envs.study.fitted_files import fitted_entries, write_fitted, write_stratified

FEW = {"method": "mc", "max_sim": 400}
OTHER_SITE = {"source": {"site": "another", "data": "more"}}


def question(base: str, **changes) -> Question:
    return Question(env_id="rare_envs/HardBrake-v0", base=base, method="mc", **{"max_sim": 500, **changes})


@pytest.fixture
def bases(tmp_path: Path) -> dict[str, str]:
    return {name: write_fitted(tmp_path / f"{name}.json", name) for name in ("cut_in", "hard_brake")}


def test_the_rate_is_p_times_the_frequency_with_the_interval_by_hand(bases: dict[str, str]) -> None:
    """42 brakings in 218 km; 30 refits of 40 scenes: t with 29 degrees of freedom."""
    report = run(prepare(question(bases["hard_brake"])))
    estimate, rate, uncertainty = report.estimate, report.rate, report.estimate.base_uncertainty
    assert rate.per_million_km == pytest.approx(1e6 * 42 / 218 * estimate.p)
    base = stats.t.ppf(0.975, 29) * math.sqrt(uncertainty.spread**2 + estimate.cov**2 + 0.2**2)
    half = math.hypot(base, stats.norm.ppf(0.975) / math.sqrt(42))
    assert rate.interval_per_million_km[0] == pytest.approx(rate.per_million_km * math.exp(-half))
    assert math.log(estimate.p / uncertainty.interval[0]) == pytest.approx(base)
    assert report_as_json(report)["rate"]["per_million_km"] == rate.per_million_km
    assert report.no_rate == ""


def test_nothing_failed(tmp_path: Path) -> None:
    base = write_fitted(tmp_path / "safe.json", "hard_brake", means=[[5.0, 100.0, 1.0, 5.0]])
    report = run(prepare(question(base, max_sim=100)))
    assert report.estimate.p == 0.0 == report.rate.per_million_km
    assert report.rate.interval_per_million_km[1] >= 1e6 * 42 / 218 * report.estimate.interval[1]
    assert "not known before a failure" in describe_left_out(report.study, report.estimate)


def test_what_counts_no_collisions_has_no_rate(bases: dict[str, str]) -> None:
    study = prepare(question(bases["hard_brake"]))
    for said, changes in (
        ("--measure drac", {"measure": "drac"}),
        ("--gamma 1", {"gamma": 1.0}),
        ("--gamma -0.5", {"measure": "margin", "gamma": -0.5}),
        ("--gamma -2", {"measure": "clearance", "gamma": -2.0}),
        ("collisions: any", {"collisions": "any"}),
    ):
        with pytest.raises(ValueError, match=said):
            find_frequency(replace(study, question=replace(study.question, **changes)))


@pytest.mark.parametrize("measure", ["clearance", "margin"])
def test_measures_that_are_positive_until_contact_have_the_rate_of_collisions(
    bases: dict[str, str], measure: str
) -> None:
    study, other = (prepare(question(bases["hard_brake"], measure=each)) for each in ("ttc", measure))
    assert find_frequency(other) == find_frequency(study)
    if measure != "margin":  # which is graded by the speed at contact
        assert find_frequency(replace(other, question=replace(other.question, gamma=-0.5))) == find_frequency(study)
    x = study.problem.base.sample(500, np.random.default_rng(0))
    collided = study.problem.evaluate(x) <= 0
    assert 0 < collided.sum() < 500
    np.testing.assert_array_equal(other.problem.evaluate(x) <= 0, collided)


def test_the_total_is_the_sum_of_frequency_times_p(bases: dict[str, str]) -> None:
    found = rare_envs.risk("idm", bases=bases, **FEW)
    p = [each.report.estimate.p for each in found.scenarios]
    expected = 1e6 * (1221 * 38 / 46 / 3900 * p[0] + 42 / 218 * p[1])
    assert found.total.per_million_km == pytest.approx(expected)
    low, high = found.total.interval_per_million_km
    assert 0 < low < expected < high
    assert sum(found.kinds.values()) == pytest.approx(expected)
    assert found.notes == ()
    assert "38 + 15 events of 17 scenes" in found.details()


def set_bases(monkeypatch: pytest.MonkeyPatch, **bases: object) -> None:
    scenario = replace(HARD_BRAKE, bases=MappingProxyType(bases))
    monkeypatch.setitem(SCENARIOS.data, "rare_envs/HardBrake-v0", scenario)


def test_the_spread_between_sites_widens_the_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sites whose rates differ by a factor r: the sd of the logarithm is log(r) / sqrt(2)."""
    other = fitted_entries("hard_brake", shift=-0.4, provenance=OTHER_SITE)
    set_bases(monkeypatch, us101=fitted_entries("hard_brake"), i80=other)
    one = rare_envs.risk("idm", scenarios=("hard_brake",), **FEW)
    two = rare_envs.risk("idm", scenarios=("hard_brake",), sites=["us101", "i80"], **FEW)
    factor = two.scenarios[0].site_factors["i80"]
    assert one.scenarios[0].site_factors == {"i80": factor}
    assert one.total.rates[0].site_log_sd == 0.0
    assert two.total.rates[0].site_log_sd == pytest.approx(abs(math.log(factor)) / math.sqrt(2))
    assert two.total.interval_per_million_km[1] > one.total.interval_per_million_km[1]
    assert ", under i80 " in one.details()


def test_other_sites_are_known_from_the_same_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    """The near site has twice the frequency; the others are too far, no sites of their own, or assembled."""
    near = fitted_entries("hard_brake", shift=0.2, provenance=OTHER_SITE)
    near["frequency"] = {**near["frequency"], "count": 84}
    set_bases(
        monkeypatch,
        us101=fitted_entries("hard_brake"),
        near=near,
        far=fitted_entries("hard_brake", shift=6.0, provenance={"source": {"site": "a third"}}),
        near_gap=fitted_entries("hard_brake", shift=0.3, provenance=OTHER_SITE),
        assembled=fitted_entries("hard_brake", refits=None, events=None, family=None, frequency=None, checks=None),
    )
    own = run(prepare(Question(env_id="rare_envs/HardBrake-v0", method="mc", max_sim=1000)))
    factors = compare_sites(own, ())
    assert list(factors) == ["near"]
    p = run(prepare(Question(env_id="rare_envs/HardBrake-v0", base="near", method="mc", max_sim=4000))).estimate.p
    assert factors["near"] == pytest.approx(2 * p / own.estimate.p, rel=0.15)


def test_a_rate_has_two_digits_and_with_its_interval_one_form() -> None:
    rates = (
        (12345.0, "12,000"),
        (99.6, "100"),
        (9.99, "10"),
        (0.0123, "0.012"),
        (0.00999, "0.010"),
        (2.3e-4, "0.00023"),
        (9e-5, "9.0e-05"),
    )
    assert [format_rate(value) for value, _ in rates] == [text for _, text in rates]
    for value, interval, text in (
        (0.011, (0.001, 0.12), "0.011 (0.0010 to 0.12)"),
        (0.003, (0.0004, 0.012), "0.0030 (0.00040 to 0.012)"),
        (3e-4, (4e-6, 0.05), "3.0e-04 (4.0e-06 to 5.0e-02)"),
        (0.0018, (3e-5, 1.9), "0.0018 (3.0e-05 to 1.9)"),
        (11.0, (0.16, 820.0), "11 (0.16 to 820)"),
        (2e-7, (0.0, 1700.0), "2.0e-07 (below 1,700)"),
    ):
        assert format_with_interval(value, interval) == text


def halves(share: float) -> StratifiedDistribution:
    """The negative and the positive half of N(0, 1), the first with this share."""
    ends = ([-np.inf], [0.0]), ([0.0], [np.inf])
    below, above = (CutNormals(low, high) for low, high in ends)
    return StratifiedDistribution(
        (Stratum("below", share, below), Stratum("above", 1.0 - share, above)), [0.0], column=0
    )


def test_the_parts_of_p_are_those_of_its_strata_with_the_error_of_their_shares() -> None:
    """P[x < -2] and P[x > 1]: s 2 Phi(-2) and (1 - s) 2 Phi(-1) with shares s; within six deviations."""
    shares = (0.4, 0.5, 0.6)
    base = FittedDistribution(
        distribution=halves(0.5),
        refits=tuple(map(halves, shares)),
        events=EventCounts(used=(40,), clusters=40, cluster="scene"),
        family="halves",
    )
    problem = SimpleNamespace(dim=1, base=base, evaluate=lambda x: np.minimum(1.0 - x[:, 0], x[:, 0] + 2.0))
    estimate = samplers.estimate(problem, "mc", seed=0, max_sim=40_000)
    expected = {"below": 2 * stats.norm.cdf(-2.0), "above": 2 * stats.norm.cdf(-1.0)}
    assert sum(part.share * part.p for part in estimate.parts) == pytest.approx(estimate.p)
    for part, error, of in zip(estimate.parts, list_part_errors(estimate), (shares, shares[::-1]), strict=True):
        name, spread = part.name, 6 * part.cov * part.share * part.p
        assert part.interval[0] < expected[name] < part.interval[1]
        for found, share in zip(error.value_refits, of, strict=True):
            assert found == pytest.approx(share * expected[name], abs=2 * spread)


def test_each_event_stands_beside_people_in_it() -> None:
    """1 + 13 + 0 contacts in 3.2187e6 km (100-Car)."""
    rate = CollisionRate(
        scenario="hard_brake",
        p=1e-4,
        sampling_log_sd=0.1,
        frequency=EventFrequency(count=268, hours=5.64, km=218.0, definition="brakings", source="US 101"),
    )
    events = [
        EventRate(event=name, rate=rate, share=share, parts={}, traffic="us101", calibration=calibration(name, "us101"))
        for name, share in (("cut_in", 1.0), ("stop", 0.15), ("slowing", 0.85))
    ]
    people = sum_people(events)
    assert people.count == 14 and people.per_million_km == pytest.approx(14 / 3.21869)
    assert sum_people([*events, replace(events[0], event="car_following")]) is None
    lines = tabulate_events([replace(events[0], parts={"looked": 0.08, "unseen": 0.92}), *events[1:]])
    assert "0.31 (0.0079 to 1.7)" in lines[1] and lines[2] == "  of which unseen 92 %, looked 8 %"
    vague = replace(events[0], parts={"looked": 1e-9, "unseen": 1.0}, unresolved={"looked": 2.58})
    assert tabulate_events([vague])[2] == "  of which unseen 100 %; stratum looked: too few failures found, below 2.6"
    assert "4.0 (2.2 to 6.9)" in lines[3] and "uncalibrated" not in lines[3]


def test_brakings_of_two_kinds_are_two_events(tmp_path: Path, bases: dict[str, str]) -> None:
    """The rate of each is frequency x share x its p; together they are that of all brakings, beside 13 + 0 contacts."""
    both = {**bases, "hard_brake": write_stratified(tmp_path / "brakings.json")}
    found = rare_envs.risk("idm", scenarios=("hard_brake",), bases={"hard_brake": both["hard_brake"]}, **FEW)
    report = found.scenarios[0].report
    parts, events = {part.name: part for part in report.estimate.parts}, {each.event: each for each in found.events}
    assert list(events) == ["slowing", "stop"]
    for name, share in (("slowing", 0.8), ("stop", 0.2)):
        rate = events[name].rate
        assert rate.per_million_km == pytest.approx(1e6 * 42 / 218 * share * parts[name].p)
        low, high = rate.interval_per_million_km
        assert low < rate.per_million_km < high
        counts = math.exp(1.96 / 42**0.5)  # more than those of the count and of the simulations alone
        assert high / rate.per_million_km > max(counts, parts[name].interval[1] / parts[name].p)
    assert sum(each.rate.per_million_km for each in found.events) == pytest.approx(found.total.per_million_km)
    assert found.people.count == 13
    assert [each["event"] for each in found.to_dict()["events"]] == ["slowing", "stop"]
    lines = str(found).splitlines()
    assert "; people 4.0 (2.2 to 6.9)" in " ".join(lines[:2])
    (whole,) = (line for line in lines if line.startswith("all "))
    assert whole.endswith(" 4.0 (2.2 to 6.9)") and f" {format_rate(found.total.per_million_km)} (" in whole


def test_a_part_without_a_failure_has_an_upper_end(tmp_path: Path) -> None:
    base = write_stratified(tmp_path / "brakings.json")
    report = run(prepare(question(base, max_sim=400, horizon=0.8)))
    assert report.estimate.p == 0 and {each.rate.determined for each in report.events} == {False}
    for each in report.events:
        assert each.rate.interval_per_million_km[1] > each.share * 1e6 * 42 / 218 * 3 / 400  # the rule of three


def test_no_event_has_more_collisions_than_there_are_events(tmp_path: Path) -> None:
    """Refits so far apart that they leave p open up to 1: at most every event of a kind is a collision.

    How many there are has the error of 42 counts and of the share, log-normal over 30 refits.
    """
    report = run(prepare(question(write_stratified(tmp_path / "brakings.json", spread=3.0), max_sim=400)))
    assert report.estimate.base_uncertainty.bound == 1.0
    refits = [[stratum.share for stratum in refit.strata] for refit in report.study.fitted.refits]
    factors = np.exp(stats.t.ppf(0.975, 29) * np.log(refits).std(axis=0, ddof=1))
    for each, factor in zip(report.events, factors, strict=True):
        events = 1e6 * 42 / 218 * min(each.share * factor, 1.0) * math.exp(1.96 / 42**0.5)
        assert each.rate.per_million_km < each.rate.interval_per_million_km[1] <= 1.0001 * events


def test_an_event_that_is_not_resolved_has_the_upper_end_of_its_stratum(tmp_path: Path) -> None:
    report = run(prepare(question(write_stratified(tmp_path / "brakings.json"), max_sim=400)))
    slowing, stop = report.estimate.parts
    vague = replace(stop, resolved=False, outcome=replace(stop.outcome, interval=(1e-9, 0.45)))
    report = replace(report, estimate=replace(report.estimate, parts=(slowing, vague)))
    known, unknown = report.events
    assert known.rate.determined and not known.unresolved
    high = 1e6 * 42 / 218 * 0.2 * 0.45 * math.exp(stats.norm.ppf(0.975) / math.sqrt(42))
    assert not unknown.rate.determined and unknown.unresolved == pytest.approx({"stop": high})
    _, first, second = tabulate_events(report.events)
    assert f"{slowing.p:.1e}" in first and "below 4.5e-01" in second and f"below {format_rate(high)}" in second
    assert f"{stop.p:.1e}" not in second


def event_of(base: str | None, env_id: str = "rare_envs/CutIn-v1", **changes):
    asked = Question(env_id=env_id, base=base, method="mc", max_sim=100, **changes)
    report = run(prepare(asked))
    assert report_as_json(report)["events"][0]["uncalibrated"] == report.events[0].uncalibrated
    return report.events[0]


def test_the_calibration_is_that_of_the_base_and_a_miss_by_more_than_three_has_its_factor() -> None:
    """Contacts of `human` per cut-in over the upper end of people's: 5.572 contacts in 3.2187e6 km."""
    at_home, elsewhere = event_of("us101"), event_of("i80")
    assert (at_home.calibration.base, elsewhere.calibration.base) == ("us101", "i80")
    assert at_home.uncalibrated == ""
    factor = elsewhere.calibration.drivers["human"]["contacts"].p * elsewhere.calibration.per_km * 3.2187e6 / 5.572
    assert factor > 3.0 and elsewhere.uncalibrated == f"uncalibrated, {factor:.2g} times above people's interval"
    assert describe_calibration(at_home).endswith("within a factor of 3 of people's interval")
    assert describe_calibration(elsewhere).endswith(f", {factor:.2g} times above people's interval")


def test_traffic_that_nobody_calibrated_is_said_to_have_no_calibration(bases: dict[str, str]) -> None:
    """The test distribution, one's own base, the script of CutIn-v0, and episodes that are cut short."""
    own = bases["cut_in"]
    for found, traffic in (
        (event_of("us101-test"), "us101-test"),
        (event_of(own), own),
        (event_of("us101", "rare_envs/CutIn-v0"), "us101"),
        (event_of("us101", horizon=2.0), "us101 with horizon"),
    ):
        assert found.calibration is None
        assert describe_calibration(found) == f"not calibrated: human driver model not measured in {Path(traffic).name}"


class Policy:
    """Keeps its speed; declares the features of two or three vehicles."""

    observation_space = observation_space(3, "features")

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2)), None


def test_the_scenarios_that_a_policy_fits_are_run(bases: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """With hard brake among five vehicles, for which the policy has not enough inputs."""
    found = rare_envs.risk(Policy(), bases=bases, method="mc", max_sim=40)
    assert not found.left_out and len(found.scenarios) == 2
    crowded = replace(HARD_BRAKE, vehicle_names=("ego", "lead", "a", "b", "c"), labels=())
    monkeypatch.setitem(SCENARIOS.data, "rare_envs/HardBrake-v0", crowded)
    found = rare_envs.risk(Policy(), bases=bases, method="mc", max_sim=40)
    assert [each.name for each in found.scenarios] == ["cut_in"] and list(found.left_out) == ["hard_brake"]
    [warning] = [each for each in found.warnings if "left out" in each]
    assert warning.startswith("hard brake is left out: The ego expects observations") and "(19,)" in warning
    stranger = Policy()
    stranger.observation_space = spaces.Box(-1.0, 1.0, (101,))
    with pytest.raises(BadInput, match=r"fits none of the scenarios cut-in, hard brake\. .*101") as refused:
        rare_envs.risk(stranger, bases=bases, method="mc", max_sim=40)
    assert "\n" not in str(refused.value)


def count_failures(a: Sequence[int], b: Sequence[int]) -> samplers.comparison.Comparison:
    """Compare two functions that fail at these of 100 draws."""

    def picks(hits: Sequence[int]) -> samplers.FunctionProblem:
        seen: dict[float, int] = {}

        def f(x: Any) -> Any:
            ranks = [seen.setdefault(float(value), len(seen)) for value in x[:, 0]]
            return np.where(np.isin(ranks, hits), -1.0, 1.0)

        return samplers.FunctionProblem(f, 1)

    return samplers.compare(picks(a), picks(b), "mc", seed=0, max_sim=200)


def add_up(**pairs: tuple[Sequence[int], Sequence[int]]) -> RiskComparison:
    """Return two egos in scenarios of which one happens each km."""
    counted = EventFrequency(count=1000, hours=10.0, km=1000.0, definition="events", source="made up")
    found = {name: count_failures(*hits) for name, hits in pairs.items()}
    return RiskComparison(ego_a="a", ego_b="b", scenarios=found, frequencies=dict.fromkeys(pairs, counted))


def test_two_egos_are_compared_by_their_sums_over_scenarios() -> None:
    """Four and two failures of 100, one of them of both, and in the other scenario two of B: 4 / 4 per 100 km."""
    found = add_up(cut_in=([0, 1, 2, 3], [0, 4]), hard_brake=([], [7, 8]))
    assert found.per_million_km == pytest.approx({"a": 4e4, "b": 4e4, "both": 1e4, "only_a": 3e4, "only_b": 3e4})
    low, high = found.interval
    assert found.ratio == pytest.approx(1.0)
    assert low < 1.0 < high
    alone = add_up(cut_in=([0, 1, 2, 3], [0, 4]))
    assert alone.interval == pytest.approx(alone.scenarios["cut_in"].interval, rel=0.1)
    lines = str(found).splitlines()
    assert len(lines) <= 12 and max(map(len, lines)) < 100 and lines[1].startswith("Ratio        a crashes 1.0 times")
    row = next(line.split() for line in found.details().splitlines() if line.startswith("all "))
    assert row == ["all", "40,000", "40,000", "10,000", "30,000", "30,000"]


def under_refits(pair: samplers.comparison.Comparison, spread: float, **changes: Any) -> samplers.comparison.Comparison:
    """Return a comparison with an error of the traffic model, and one of P[A or B fails] with a spread."""
    about: dict[str, Any] = {"value": pair.ratio, "interval": (2.0, 9.0), "spread": 0.1, "ess_refits": (99.0,) * 40}
    about |= {
        "value_refits": (1.0,) * 40,
        "clusters": 17,
        "confidence": 0.95,
        "fitted_to": "20 events",
        "family": "one",
    }
    of_ratio = samplers.analysis.BaseUncertainty(**{**about, **changes})
    either = replace(pair.either)
    vars(either)["base_uncertainty"] = replace(of_ratio, spread=spread, reason="no refit reaches them.", warnings=())
    return replace(pair, base_uncertainty=of_ratio, either=either)


@pytest.mark.parametrize(
    "changes", [{"interval": None, "reason": "why."}, {"warnings": ("The refits reach far.",)}, {}]
)
@pytest.mark.parametrize("of_b", [[], [0, 1]], ids=["never", "less"])
def test_the_sum_of_one_scenario_is_judged_as_that_scenario(changes: dict[str, Any], of_b: Sequence[int]) -> None:
    """An unknown error of the traffic model and a warning of it leave both undecided, for the same reason."""
    found = add_up(cut_in=([*range(60)], of_b))
    pair = under_refits(found.scenarios["cut_in"], 0.5, **changes)
    one, verdict = pair.meets(0.8), replace(found, scenarios={"cut_in": pair}, max_ratio=0.8).verdict
    assert verdict is not None and one.decision == ("undecided" if changes else "passes")
    for name in ("decision", "includes_base", "if_exact", "limit", "confidence"):
        assert getattr(verdict, name) == getattr(one, name)
    assert verdict.reason.replace("cut-in: ", "") == one.reason


def test_the_error_of_a_traffic_model_weighs_in_sums_as_in_rates_or_is_said_to_be_missing() -> None:
    """Of 17 clusters t is 2.12 where the normal quantile is 1.96: log p has 1.08 (0.5^2 + 0.2^2)^0.5."""
    found = add_up(cut_in=([0, 1], [0, 1]))
    known, unknown = (under_refits(found.scenarios["cut_in"], spread) for spread in (0.5, math.nan))
    assert fold_spread(known.either.base_uncertainty) == pytest.approx((1.0816, 0.5825), abs=1e-3)
    found = replace(found, scenarios={"cut_in": unknown}, max_ratio=100.0)
    assert found.verdict is not None and found.verdict.cause == "cut-in: no refit reaches them"
    assert "error of the traffic model (cut-in: no refit reaches them)" in " ".join(str(found).split())


def test_a_ratio_is_called_better_known_if_it_is_and_what_no_draw_showed_has_a_limit() -> None:
    found = add_up(cut_in=([*range(9)], [*range(9)]))
    pair = found.scenarios["cut_in"]
    for ends, better in (((0.9, 1.1), True), ((0.01, 100.0), False)):
        assert is_better_known(replace(pair, interval=ends).to_dict()) == better
    row = next(line for line in str(found).splitlines() if line.startswith("crashes  "))
    assert row.split()[-5:-1] == ["below", "39,000"] * 2  # 36,000 of 100 draws, times 1.06 for the count of events


@pytest.mark.slow
def test_compare_without_a_scenario_sums_over_those_of_risk(cli: Any, tmp_path: Path) -> None:
    words = ("compare", "idm", "cc_human", "--method", "mc", "--max-sim", 200, "--seed", 0)
    done = cli(*words, "--out", tmp_path / "pair", "--json")
    assert done.exit_code == 3, done.stderr
    found = json.loads(done.stdout)
    assert found == json.loads((tmp_path / "pair" / "comparison.json").read_text())
    assert list(found["scenarios"]) == ["cut_in", "hard_brake"]
    assert found["scenarios"]["cut_in"]["shares"]["neither"] == 1.0
    assert "finished run" in cli(*words, "--out", tmp_path / "pair").stderr
    assert list(found["outcomes"])[:2] == ["near_crashes", "serious_injuries"]
    assert (tmp_path / "pair" / "hard_brake_near_crashes" / "comparison.json").exists()
    assert cli("report", tmp_path / "pair").exit_code == 0
    page = (tmp_path / "pair" / "report.html").read_text()
    assert "+ near-crashes" in page and "cut-in: no failure was found" in page
    gated = cli(*words, "--max-ratio", 1)
    assert gated.exit_code == 5 and gated.stdout.splitlines()[-1].startswith("GATE undecided (exit code 5)")
