"""Statements of the paper against runs made by hand."""

from __future__ import annotations

from benchmarks.papers.tian2024.claims import assess_claims
from benchmarks.papers.tian2024.replications import ReplicationJob
from tests.benchmarks.papers.tian2024.made_runs import made_run


def claims_of(spreads: dict[str, float], points: bool = False, shift: float = 0.0):
    jobs = [
        ReplicationJob("cut-in", "IDM", name, seed, points and name == "SS") for name in spreads for seed in range(20)
    ]
    runs = []
    for job in jobs:
        p = 2e-4 * (1 + spreads[job.method] * (-1) ** job.seed + (shift if job.method == "IS" else 0.0))
        runs.append(made_run(job, p))
    return {claim.claim.partition(" (")[0]: claim for claim in assess_claims(runs)}


def test_which_method_needs_fewer_simulations() -> None:
    found = claims_of({"MC": 0.1, "ADSS": 0.2, "SS": 0.6, "IS": 0.05})
    assert found["ADSS needs fewer simulations than SS"].verdict == "holds"
    assert found["ADSS needs fewer simulations than IS"].verdict == "the opposite holds"
    equal = claims_of({"MC": 0.1, "ADSS": 0.3, "SS": 0.3})
    assert equal["ADSS needs fewer simulations than SS"].verdict == "cannot be told from these replications"


def test_an_error_of_importance_sampling_is_seen_where_there_is_one() -> None:
    name = "IS is off by 2 to 17 %"
    assert claims_of({"MC": 0.1, "IS": 0.1})[name].verdict == "no error to be seen"
    assert claims_of({"MC": 0.1, "IS": 0.1}, shift=0.2)[name].verdict == "off by +20 %"


def test_what_moves_from_the_first_subset_to_the_last() -> None:
    found = claims_of({"MC": 0.1, "SS": 0.3}, points=True)
    assert found["the cutter's speed v2 increases from subset to subset"].verdict == "the opposite holds"
    gap = found["the gap dis1x to it decreases from subset to subset"]
    assert (gap.value, gap.verdict) == (-30.0, "holds")


def test_no_runs_no_claims() -> None:
    assert assess_claims([]) == []
