"""Two egos in the same draws: crashes, near-crashes and severity, their shares, and sums over scenarios."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

import rare_envs
import samplers
from rare_envs.distributions.events import EventFrequency
from rare_envs.exposure import MILLION_KM
from rare_envs.study.arguments import BadInput
from rare_envs.study.compared_risks import RiskComparison, compare_risks
from rare_envs.study.comparison import RateComparison, compare_egos, weigh_crashes
from rare_envs.study.question import Question
from rare_envs.study.run_folder import read_failures
from tests.rare_envs.study.conftest import write_base

Array = NDArray[np.float64]
BRAKING = 0.25  # deceleration of B [m/s^2], 10 s long; A keeps its speed


def meet(base: Path, n: int) -> tuple[Array, Array]:
    """Return by pencil and paper whether A and B run into a lead that keeps its speed, and how fast, (2, n)."""
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", base=str(base))
    speed, lead, gap = problem.space.sample(n, np.random.default_rng(1)).T
    closing = np.stack([speed - lead] * 2)
    braking = np.array([[0.0], [BRAKING]])
    reach = 10.0 * closing - 50.0 * braking  # both still close in after 10 s, closing > 2.5 m/s
    at_contact = np.sqrt(np.maximum(closing**2 - 2.0 * braking * gap, 0.0))
    return reach > gap, np.where(reach > gap, at_contact, 0.0)


def test_severity_and_shares_are_those_of_pencil_and_paper(tmp_path: Path) -> None:
    """Delta-v is half of the speed at contact, as both cars weigh the same; 4 standard errors of 3,000 draws."""
    base = write_base(tmp_path / "base.json", gap=115.0)
    hits, speed = meet(base, 400_000)
    egos = [lambda seen, a=a: np.tile([-a / 5.0, 0.0], (len(seen), 1)) for a in (0.0, BRAKING)]  # of 5 m/s^2
    problems = [rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=ego, base=str(base)) for ego in egos]
    found = samplers.compare(*problems, "mc", seed=0, max_sim=6000)
    severity = weigh_crashes(found, problems)
    harder = severity.outcomes["delta_v_above_5"]
    for pair, (a, b) in ((found, hits), (harder, speed > 10.0)):
        for name, truth in (("both", a & b), ("only_a", a & ~b), ("only_b", b & ~a)):
            p = truth.mean()
            assert abs(pair.shares[name] - p) < 4.0 * math.sqrt(p * (1.0 - p) / 3000) + 2e-3, name  # ticks of 0.1 s
    injuries = severity.outcomes["serious_injuries"]
    assert injuries.parts["only_a"].p > 0 == injuries.parts["only_b"].p
    assert severity.kinds == {"rear_end": pytest.approx((found.a.p, found.parts["only_a"].p))}


def test_failures_of_a_comparison_have_f_of_both(here: Path, risky: str) -> None:
    question = Question(
        env_id="rare_envs/CarFollowing-v0", base=risky, ego="egos_here:coasting", method="mc", max_sim=400
    )
    pair = compare_egos(question, "idm", out=here / "pair")
    table = read_failures(here / "pair")
    assert np.minimum(table["f_A"], table["f_B"]) == pytest.approx(table["f"])
    assert (table["f_A"] <= 0).sum() == round(200 * pair.found.a.p) > (table["f_B"] <= 0).sum()
    assert pair.answer["kinds_of_a"]["rear_end"]["avoided_by_b"] > 0.5


def half_spaces(*at: float) -> list[samplers.FunctionProblem]:
    """A fails beyond the first plane; B beyond the second, which has another direction."""
    return [
        samplers.FunctionProblem(lambda u, at=each, j=j: at - (0.6 * u[:, 0] + 0.8 * u[:, j + 1]), 3)
        for j, each in enumerate(at)
    ]


def compute_exact(a: float, b: float) -> dict[str, float]:
    """P[A], P[B] and the shares: the two are normal with a correlation of 0.36."""
    both = float(stats.multivariate_normal.cdf([-a, -b], cov=[[1.0, 0.36], [0.36, 1.0]]))
    p_a, p_b = stats.norm.sf(a), stats.norm.sf(b)
    return {"a": p_a, "b": p_b, "both": both, "only_a": p_a - both, "only_b": p_b - both}


@pytest.mark.parametrize(
    ("at", "max_ratio", "decision", "said"),
    [
        ((2.0, 9.0), 1.0, "passes", "cc_human crashes more than "),  # B never fails: its upper limit counts
        ((2.0, 9.0), 0.01, "undecided", "no failure of ppo.zip"),
        ((9.0, 2.0), 1.0, "fails", "cc_human crashes less than "),
        ((9.0, 9.0), 1.0, "undecided", "not known: no failure of cc_human or ppo.zip found"),
    ],
)
def test_an_ego_without_a_failure_has_limits(
    at: tuple[float, float], max_ratio: float, decision: str, said: str
) -> None:
    about: dict[str, Any] = {"hours": 10.0, "km": 4000.0, "definition": "events", "source": "made up"}
    found = RiskComparison(
        ego_a="cc_human",
        ego_b="ppo.zip",
        scenarios={"cut_in": samplers.compare(*half_spaces(*at), "mc", seed=0, max_sim=6000)},
        frequencies={"cut_in": EventFrequency(count=1000, **about)},
        max_ratio=max_ratio,
    )
    assert found.verdict is not None and found.verdict.decision == decision
    assert said in " ".join(str(found).split())
    assert found.to_dict()["ratio"] is None or at == (9.0, 2.0)
    truth = compute_exact(*at)
    for key, rate in found.rates.items():
        low, high = rate.interval_per_million_km
        assert low <= 1e6 * 0.25 * truth[key] <= high and high > 0, key
    # a careful human that crashes more often than people says that the traffic is at fault
    assert ("cc_human crashes 15,000 times as often as people" in str(found)) == (at[0] == 2.0)


@pytest.mark.parametrize(("crashes", "near", "said"), [(1.5, 2.0, True), (2.0, 1.5, False)])
def test_near_crashes_below_the_crashes_that_they_include_are_pointed_out(
    crashes: float, near: float, said: bool
) -> None:
    made_up = EventFrequency(count=1000, hours=10.0, km=4000.0, definition="events", source="made up")
    whole, of_near = (
        RateComparison(
            scenarios={"cut_in": samplers.compare(*half_spaces(at, at), "mc", seed=0, max_sim=2000)},
            frequencies={"cut_in": made_up},
        )
        for at in (crashes, near)
    )
    found = RiskComparison(ego_a="idm", ego_b="rss", outcomes={"near_crashes": of_near}, **vars(whole))
    assert ("Careful      found + near-crashes below crashes, which they include" in str(found)) == said


def test_few_simulations_bound_all_and_fewer_are_refused() -> None:
    with pytest.raises(BadInput, match="at least 8, got 7"):
        compare_risks("idm", "rss", max_sim=7)
    found = compare_risks("idm", "rss", scenarios=["hard_brake"], max_sim=8, max_ratio=1.0, seed=0)
    assert found.n_sim == 8 and found.verdict is not None and found.verdict.decision == "undecided"
    assert math.isnan(found.ratio) and all(rate.interval_per_million_km[1] > 1e5 for rate in found.rates.values())


@pytest.mark.slow
def test_intervals_of_sums_of_scenarios_hold_ratios_and_shares() -> None:
    """Counts of events are drawn anew, and so are the simulations; 1 in 1,000 of 60 runs at 93 % hold fewer."""
    planes, per_km, n, km = {"x": (2.8, 3.0), "y": (3.4, 3.0)}, {"x": 0.3, "y": 1.2}, 60, 200.0
    truths = {name: compute_exact(*at) for name, at in planes.items()}
    rates = {key: MILLION_KM * sum(per_km[name] * each[key] for name, each in truths.items()) for key in truths["x"]}
    held: dict[str, list[bool]] = {key: [] for key in (*rates, "ratio")}
    for seed in range(n):
        rng = np.random.default_rng(seed)
        counts = {name: int(rng.poisson(each * km)) for name, each in per_km.items()}
        about: dict[str, Any] = {"hours": 10.0, "km": km, "definition": "events", "source": "made up"}
        found = RateComparison(
            scenarios={
                name: samplers.compare(*half_spaces(*at), seed=seed, max_sim=6000) for name, at in planes.items()
            },
            frequencies={name: EventFrequency(count=count, **about) for name, count in counts.items()},
        )
        for key, rate in found.rates.items():
            low, high = rate.interval_per_million_km
            held[key].append(low <= rates[key] <= high)
        held["ratio"].append(found.interval[0] <= rates["a"] / rates["b"] <= found.interval[1])
    assert {key: sum(each) for key, each in held.items() if sum(each) < stats.binom.ppf(1e-3, n, 0.93)} == {}


@pytest.mark.slow
@pytest.mark.parametrize("at", [(3.0, 3.0), (2.5, 3.5)], ids=["alike", "apart"])
def test_intervals_of_shares_and_of_values_hold_the_truth(at: tuple[float, float]) -> None:
    """The value is how far beyond its plane a point is: E[max(Z - b, 0)] = phi(b) - b P[Z > b]."""
    truth, held = compute_exact(*at), dict[str, list[bool]]()
    mean_a, mean_b = (stats.norm.pdf(b) - b * stats.norm.sf(b) for b in at)
    for seed in range(60):
        a, b = half_spaces(*at)
        found = samplers.compare(a, b, seed=seed, max_sim=6000)
        beyond = found.weigh(lambda x, a=a, b=b: np.maximum([-a.evaluate(x), -b.evaluate(x)], 0.0))
        checks = [(name, interval, truth[name]) for name, interval in found.share_intervals.items() if name in truth]
        checks += [("value of a", beyond.a.interval, mean_a), ("ratio of values", beyond.interval, mean_a / mean_b)]
        for name, (low, high), value in checks:
            held.setdefault(name, []).append(bool(low <= value <= high))
    assert {name: sum(each) for name, each in held.items() if sum(each) < stats.binom.ppf(1e-3, 60, 0.93)} == {}
