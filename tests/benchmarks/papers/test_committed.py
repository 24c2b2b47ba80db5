"""The committed records are what the command gives."""

from __future__ import annotations

import pytest

from benchmarks.papers.renew import read_records, read_replications
from benchmarks.papers.tian2024.replications import ReplicationJob, ReplicationRun, run_replication
from benchmarks.papers.tian2024.tables import make_method_tables
from rare_envs.threads import use_one_thread
from samplers.output import to_json_value
from tests.benchmarks.papers.same_records import assert_same


@pytest.fixture(scope="module")
def tian():
    return read_records()["tian2024"]


def runs_of(record, scenario: str, system: str, method: str):
    (found,) = [
        runs
        for runs in record["runs"]
        if (runs["scenario"], runs["system"], runs["method"]) == (scenario, system, method)
    ]
    return found


@pytest.mark.parametrize(
    ("scenario", "method", "place"),
    [("car-following", "IS", 0), ("car-following", "SS", 7), ("cut-in", "ADSS", 19), ("cut-in", "cross-entropy", 3)],
)
def test_a_cheap_run_made_again_gives_the_committed_value(tian, scenario: str, method: str, place: int) -> None:
    runs = runs_of(tian, scenario, "IDM", method)
    with use_one_thread():
        again = run_replication(ReplicationJob(scenario, "IDM", method, runs["seed"][place]))
    assert again.p == pytest.approx(runs["p"][place], rel=1e-6)
    assert (again.n_sim, again.simulated) == (runs["n_sim"][place], runs["simulated"][place])


def test_committed_tables_follow_from_the_committed_runs(tian) -> None:
    counts = {runs["method"]: len(runs["p"]) for runs in tian["runs"]}
    assert counts.pop("MC") == tian["about"]["replications_of_monte_carlo"]
    assert {counts.pop(method) for method in ("IS", "SS", "ADSS")} == {tian["about"]["replications"]}
    assert set(counts.values()) == {tian["about"]["replications_of_further_methods"]}
    assert tian["about"]["replications"] >= 20
    assert_same(tables_of(read_replications(tian)), tian["tables"])


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "method"), [("car-following", "ADSS"), ("cut-in", "two-stage")])
def test_a_row_of_the_committed_tables_made_again_is_the_committed_one(tian, scenario: str, method: str) -> None:
    runs = read_replications(tian)
    with use_one_thread():
        for place, run in enumerate(runs):
            if (run.scenario, run.system, run.method) == (scenario, "IDM", method):
                runs[place] = run_replication(ReplicationJob(*run.key))
    for again, shown in zip(tables_of(runs), tian["tables"], strict=True):
        for one, other in zip(again["values"], shown["values"], strict=True):
            assert one["ours"] == pytest.approx(other["ours"], rel=1e-6)
            assert {**one, "ours": 0, "interval": 0, "difference": 0} == {
                **other, "ours": 0, "interval": 0, "difference": 0
            }  # fmt: skip
        for one, other in zip(again["measured"], shown["measured"], strict=True):
            assert one["labels"] == other["labels"]
            assert one["values"] == pytest.approx(other["values"], rel=1e-6)


def tables_of(runs: list[ReplicationRun]):
    return to_json_value([table.to_dict() for table in make_method_tables(runs)])


def test_no_method_hides_simulations_by_its_own_count(tian) -> None:
    for runs in tian["runs"]:
        assert all(made >= stated for made, stated in zip(runs["simulated"], runs["n_sim"], strict=True))
