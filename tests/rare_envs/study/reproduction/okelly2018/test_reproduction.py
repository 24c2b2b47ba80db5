"""The whole reproduction on a problem that costs nothing, and its committed record."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.papers.page import read_records
from rare_envs.study.reproduction.okelly2018 import summary
from rare_envs.study.reproduction.okelly2018.behaviour import RunBehaviour
from rare_envs.study.reproduction.okelly2018.reproduction import (
    make_okelly_record,
    reproduce_okelly2018,
    write_notes,
)
from rare_envs.study.reproduction.okelly2018.scales import PRINTED_SEARCH, SEARCHES
from rare_envs.study.reproduction.okelly2018.search import draw_chunk, make_base
from rare_envs.study.reproduction.okelly2018.study import HighwayStudy


def test_record_and_page_are_written(
    tiny: HighwayStudy, cheap: Any, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HighwayStudy, "make_problem", lambda self: cheap)
    monkeypatch.setattr(summary, "measure_behaviour", lambda problem, x: RunBehaviour(*np.ones((4, len(x)))))
    record = reproduce_okelly2018(tiny, out, "rare-envs reproduce okelly2018")
    assert json.loads((out / "reproduction.json").read_text()) == record
    page = (out / "reproduction.html").read_text()
    assert page.count("<svg") == 2
    assert "Made: 4,600 of 4,600 rollouts" in page
    assert "The full scale has 1,300,000 naive rollouts" in page
    assert len(record["findings"]) == 11


def test_a_full_scale_that_is_not_all_run_says_what_the_rest_takes() -> None:
    study = HighwayStudy("lidar", "full")
    found = {"rollouts": study.settings.rollouts - 24_000, "own": [], "naive": [], "rollouts_per_second": 1000.0}
    assert "the rest takes 0.0 hours" in write_notes(study, found)[-1]
    found["rollouts"] -= 3_600_000
    assert "At the 1e+03 rollouts a second" in write_notes(study, found)[-1]
    assert "the rest takes 1.0 hours of a core; the same command goes on" in write_notes(study, found)[-1]
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
    for part in ("title", "source", "tables", "figures"):
        assert anew[part] == committed[part]
    assert set(anew["notes"][:3]) <= set(committed["notes"])  # which may have a remark of their own on the speed


def test_the_first_rollouts_are_those_of_the_committed_run(committed: dict[str, Any]) -> None:
    study = study_of(committed)
    highway = study.make_problem()
    base = make_base(highway, SEARCHES[PRINTED_SEARCH])
    first = committed["runs"][0]["first"]
    x = draw_chunk(base, study.settings.chunk, committed["about"]["seed"], "naive/0")[: len(first)]
    assert highway.evaluate(x) == pytest.approx(first, abs=1e-3)


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
