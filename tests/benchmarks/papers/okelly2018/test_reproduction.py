"""The whole reproduction on a problem that costs nothing, and its committed record."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import samplers
from benchmarks.papers.okelly2018 import summary
from benchmarks.papers.okelly2018.behaviour import RunBehaviour
from benchmarks.papers.okelly2018.reproduction import (
    make_okelly_record,
    reproduce_okelly2018,
    write_notes,
)
from benchmarks.papers.okelly2018.rollouts import split_jobs
from benchmarks.papers.okelly2018.scales import CORE_SPEEDS, PRINTED_SEARCH, SEARCHES
from benchmarks.papers.okelly2018.search import draw_chunk, make_base, take_step
from benchmarks.papers.okelly2018.study import HighwayStudy
from benchmarks.papers.renew import read_records
from rare_envs.threads import use_one_thread


def test_record_and_page_are_written(
    tiny: HighwayStudy, cheap: Any, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HighwayStudy, "make_problem", lambda self: cheap)
    monkeypatch.setattr(summary, "measure_behaviour", lambda problem, x: RunBehaviour(*np.ones((4, len(x)))))
    record = reproduce_okelly2018(tiny, out, "python -m benchmarks.papers okelly2018")
    assert json.loads((out / "reproduction.json").read_text()) == record
    page = (out / "reproduction.md").read_text()
    assert {path.stem for path in out.glob("*.png")} == {"figure2a", "figure2b"}
    assert "Made: 4,600 of 4,600 rollouts" in page
    assert "The full scale has 1,300,000 naive rollouts" in page
    assert len(record["findings"]) == 11


def test_a_full_scale_that_is_not_all_run_says_what_the_rest_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CORE_SPEEDS, "lidar", 1000.0)
    study = HighwayStudy("lidar", "full")
    found = {"rollouts": study.settings.rollouts - 24_000, "own": [], "naive": []}
    assert "the rest takes 0.0 hours" in write_notes(study, found)[-1]
    found["rollouts"] -= 3_600_000
    assert "At 1,000 rollouts a second" in write_notes(study, found)[-1]
    assert "the rest takes 1.0 hours; the same command goes on" in write_notes(study, found)[-1]
    done = {**found, "rollouts": study.settings.rollouts - 24_000, "own": [{"n_sim": 6000}] * 4}
    assert len(write_notes(study, done)) == 2


@pytest.fixture(scope="module", params=[name for name in read_records() if name.startswith("okelly")])
def committed(request: pytest.FixtureRequest) -> dict[str, Any]:
    return read_records()[request.param]


def study_of(record: dict[str, Any]) -> HighwayStudy:
    about = record["about"]
    return HighwayStudy(about["ego"], about["scale"], about["seed"])


def test_committed_tables_and_figures_follow_from_the_committed_estimates(committed: dict[str, Any]) -> None:
    study, (details,) = study_of(committed), committed["runs"]
    anew = make_okelly_record(study, committed["command"], {**details, "findings": []})
    for part in ("title", "source", "notes", "tables", "figures"):
        assert anew[part] == committed[part]


def test_the_first_rollouts_are_those_of_the_committed_run(committed: dict[str, Any]) -> None:
    study = study_of(committed)
    highway = study.make_problem()
    base = make_base(highway, SEARCHES[PRINTED_SEARCH])
    first = committed["runs"][0]["first"]
    x = draw_chunk(base, study.settings.chunk, committed["about"]["seed"], "naive/0")[: len(first)]
    assert highway.evaluate(x) == pytest.approx(first, abs=1e-3)


def test_the_first_iteration_of_a_search_made_again_is_the_committed_one(highway: Any) -> None:
    """Of the small scale: 1,000 rollouts."""
    record = read_records()["okelly2018"]
    study, name = study_of(record), "starts alone, rho 0.1"
    base, number = make_base(highway, SEARCHES[name]), list(SEARCHES).index(name) + 1
    (job,) = split_jobs(f"search_{number}/0", study.settings.draws, study.settings.chunk, base)
    x = draw_chunk(base, job.n, study.seed, job.key)
    step, _ = take_step(base, base, x, highway.evaluate(x), SEARCHES[name], study.gammas[0])
    shown = record["runs"][0]["searches"][name]["steps"][0]
    assert (step.elite, step.ess) == (shown["elite"], pytest.approx(shown["ess"]))
    assert (step.quantile, step.level) == pytest.approx((shown["quantile"], shown["level"]), rel=1e-5)


@pytest.mark.slow
def test_rows_of_the_committed_table_are_what_the_command_makes_again(out: Path) -> None:
    """Naive Monte Carlo with as many draws as a final sample has, and our default method at one threshold."""
    record = read_records()["okelly2018"]
    study = study_of(record)
    with use_one_thread():
        reproduce_okelly2018(study, out, record["command"], limit=study.settings.final)
        problem = study.make_problem()
        own = samplers.estimate(problem, gamma=study.gammas[-1], seed=study.seed, max_sim=study.settings.own)
    again = json.loads((out / "reproduction.json").read_text())
    rows = [values_of(each, "naive, equal draws") for each in (again, record)]
    assert len(rows[0]) == 1 + 2 * len(study.gammas)
    assert rows[0] == rows[1]
    shown = {value["quantity"]: value for value in values_of(record, f"our default method, {own.n_sim:,} simulations")}
    assert (own.p, *own.interval) == pytest.approx((shown["p"]["ours"], *shown["p"]["interval"]), rel=1e-6)
    assert own.p * own.cov == pytest.approx(shown["standard error"]["ours"], rel=1e-6)


def values_of(record: dict[str, Any], label: str) -> list[dict[str, Any]]:
    """Return the values of a row of the first table, whose label begins with some words."""
    return [value for value in record["tables"][0]["values"] if value["labels"][0].startswith(label)]


def test_committed_rows_add_up(committed: dict[str, Any]) -> None:
    (details,), scale = committed["runs"], study_of(committed).settings
    assert committed["about"]["rollouts"] == asdict(scale)
    naive, searches = details["naive"], details["searches"].values()
    assert details["rollouts"] == naive[0]["n"] + sum(each["search"] + each["final"] for each in searches)
    assert details["rollouts"] <= scale.naive + len(SEARCHES) * scale.per_search
    for row in naive:
        assert row["p"] == row["events"] / row["n"]
    assert [own["gamma"] for own in details["own"]] == [row["gamma"] for row in naive][: len(details["own"])]


def test_the_small_scale_with_the_lidar_is_complete() -> None:
    (details,) = read_records()["okelly2018"]["runs"]
    scale = HighwayStudy().settings
    assert details["rollouts"] == scale.naive + len(SEARCHES) * scale.per_search
    assert len(details["own"]) == 4
