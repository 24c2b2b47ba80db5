"""The reproduction in a folder: resumed, refused where it does not fit, recorded with what made it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.papers.tian2024 import study
from benchmarks.papers.tian2024.study import TianPlan, reproduce_tian2024
from rare_envs.study.errors import BadInput
from tests.benchmarks.papers.tian2024.made_runs import made_run

PLAN = TianPlan(replications=2)
COMMAND = "python -m benchmarks.papers tian2024 --replications 2 --seed 0"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple]:
    """Replications made by hand; those that were asked for are listed."""
    asked: list[tuple] = []

    def make(job):
        asked.append((job.scenario, job.system, job.method, job.seed))
        return made_run(job)

    monkeypatch.setattr(study, "run_replication", make)
    return asked


def test_a_folder_has_lines_record_and_page(made, tmp_path: Path) -> None:
    record = reproduce_tian2024(PLAN, tmp_path, COMMAND)
    assert len(made) == len((tmp_path / "runs.jsonl").read_text().splitlines()) - 1 == 64
    assert json.loads((tmp_path / "reproduction.json").read_text()) == record
    assert (record["about"]["seeds"], record["command"]) == ("0 to 1", COMMAND)
    assert [table["name"] for table in record["tables"]] == ["table2", "table3"]
    first = record["runs"][0]
    assert (first["scenario"], first["system"], first["method"]) == ("car-following", "IDM", "IS")
    assert (first["seed"], first["p"], first["warnings"]) == ([0, 1], [1.5e-4, 2.5e-4], [1, 1])
    assert first["high"] == [None, None]
    page = (tmp_path / "reproduction.md").read_text()
    assert all(text in page for text in ("Table II", "Table III", "### Findings", "### Figures"))
    assert {path.stem for path in tmp_path.glob("*.png")} == {"figure6", "figure7", "figure8"}


def test_a_torn_line_alone_is_made_again(made, tmp_path: Path) -> None:
    whole = reproduce_tian2024(PLAN, tmp_path, COMMAND)
    file = tmp_path / "runs.jsonl"
    text = file.read_text()
    file.write_text(text[:-30])
    made.clear()
    assert reproduce_tian2024(PLAN, tmp_path, COMMAND) == whole
    assert made == [("cut-in", "stack", "MC", 1)]
    assert file.read_text() == text


def test_other_replications_are_refused_before_any_is_made(made, tmp_path: Path) -> None:
    reproduce_tian2024(PLAN, tmp_path, COMMAND)
    before = (tmp_path / "runs.jsonl").read_text()
    made.clear()
    with pytest.raises(BadInput, match="holds tian2024, replications 2, seed 0; this is tian2024, replications 3"):
        reproduce_tian2024(TianPlan(replications=3), tmp_path, COMMAND)
    assert made == []
    assert (tmp_path / "runs.jsonl").read_text() == before


def test_monte_carlo_and_further_methods_may_have_fewer_replications(made, tmp_path: Path) -> None:
    record = reproduce_tian2024(TianPlan(replications=4, monte_carlo=2, further=3), tmp_path, COMMAND)
    counts = {runs["method"]: len(runs["p"]) for runs in record["runs"]}
    assert (counts["MC"], counts["SS"], counts["two-stage"]) == (2, 4, 3)
    assert "over 4 replications (Monte Carlo 2, methods that the paper does not have 3;" in record["notes"][0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"replications": 1}, "2 replications at least"),
        ({"seed": -1}, "a seed of at least 0"),
        ({"monte_carlo": 1}, "2 to 20 replications of Monte Carlo"),
        ({"monte_carlo": 21}, "2 to 20 replications of Monte Carlo"),
        ({"further": 1}, "2 to 20 replications of further methods"),
        ({"scenarios": ("parking",)}, "a scenario of car-following, cut-in, got 'parking'"),
        ({"systems": ()}, "a system of IDM, stack, got none"),
        ({"methods": ("MC", "magic")}, "got 'magic'"),
        ({"methods": ("IS",)}, "MC among the methods"),
    ],
)
def test_plans_that_cannot_be_run_are_refused(changes, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        TianPlan(**changes)
