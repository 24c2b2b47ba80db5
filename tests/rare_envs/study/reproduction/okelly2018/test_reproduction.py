"""The whole reproduction on a problem that costs nothing, and its committed record."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import RESULTS
from rare_envs.study.reproduction.okelly2018 import summary
from rare_envs.study.reproduction.okelly2018.behaviour import RunBehaviour
from rare_envs.study.reproduction.okelly2018.reproduction import make_okelly_record, reproduce_okelly2018
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
    assert "The full scale was not run" in page
    assert len(record["findings"]) == 11


@pytest.fixture(scope="module")
def committed() -> dict[str, Any]:
    record: dict[str, Any] = json.loads((RESULTS / "okelly2018.json").read_text())
    return record


def test_committed_tables_and_figures_follow_from_the_committed_estimates(committed: dict[str, Any]) -> None:
    study, (details,) = HighwayStudy(seed=committed["about"]["seed"]), committed["runs"]
    anew = make_okelly_record(study, committed["command"], {**details, "findings": []})
    for part in ("title", "source", "tables", "figures"):
        assert anew[part] == committed[part]
    assert set(anew["notes"]) <= set(committed["notes"])  # which may have a remark on the ego


def test_the_first_rollouts_are_those_of_the_committed_run(committed: dict[str, Any]) -> None:
    highway = HighwayStudy().make_problem()
    base = make_base(highway, SEARCHES[PRINTED_SEARCH])
    first = committed["runs"][0]["first"]
    x = draw_chunk(base, HighwayStudy().settings.chunk, committed["about"]["seed"], "naive/0")[: len(first)]
    assert highway.evaluate(x) == pytest.approx(first, abs=1e-3)


def test_committed_rows_add_up(committed: dict[str, Any]) -> None:
    (details,), scale = committed["runs"], HighwayStudy().settings
    assert committed["about"]["rollouts"] == asdict(scale)
    assert details["rollouts"] == scale.naive + len(SEARCHES) * scale.per_search
    for row in details["naive"]:
        assert row["p"] == row["events"] / scale.naive
    assert [own["gamma"] for own in details["own"]] == [row["gamma"] for row in details["naive"]]
