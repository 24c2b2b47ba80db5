"""Records of both papers: what the command writes and refuses; the committed ones follow from their runs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

import rare_envs
from benchmarks.papers.__main__ import main
from benchmarks.papers.okelly2018.reproduction import make_okelly_record
from benchmarks.papers.okelly2018.study import HighwayStudy
from benchmarks.papers.record import check_folder, compare, find, format_record, make_record, make_table, write_record
from benchmarks.papers.tian2024.replications import (
    FURTHER_COLUMNS,
    ROW_COLUMNS,
    RUN_COLUMNS,
    ReplicationJob,
    Run,
    TianPlan,
    run_replication,
)
from benchmarks.papers.tian2024.study import record_replications
from benchmarks.results_page import read
from rare_envs.startup import use_one_thread
from rare_envs.study.arguments import BadInput
from samplers.output import to_json_value

OKELLY, TIAN = "okelly2018", "tian2024"
TIAN_RUNS, HIGHWAY_RUNS = TianPlan(5).identity, HighwayStudy().identity


def assert_same(one: Any, other: Any, place: str = "") -> None:
    """Compare two records; numbers may differ by rounding, as another SciPy rounds a quantile otherwise."""
    if isinstance(one, dict) and isinstance(other, dict):
        assert set(one) == set(other), place
        for name, value in one.items():
            assert_same(value, other[name], f"{place}/{name}")
    elif isinstance(one, list) and isinstance(other, list):
        assert len(one) == len(other), place
        for at, (value, shown) in enumerate(zip(one, other, strict=True)):
            assert_same(value, shown, f"{place}/{at}")
    elif isinstance(one, float) and isinstance(other, float):
        assert one == pytest.approx(other, rel=1e-9, nan_ok=True), place
    else:
        assert one == other, place


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([OKELLY, "--scale", "huge"], "a scale of small, full"),
        ([OKELLY, "--ego", "radar"], "an ego of lidar, vision"),
        ([OKELLY, "--seed", "-1"], "a seed of 0 or more"),
        ([OKELLY, "--at-most", "-1"], "--at-most to be 0 or more"),
        ([OKELLY, "--workers", "0"], "--workers to be 1 or more"),
        ([TIAN, "--replications", "1"], "2 replications at least"),
        ([TIAN, "--seed", "-1"], "a seed of at least 0"),
    ],
)
def test_bad_options_are_one_line(tmp_path: Path, words: list[str], message: str, capsys) -> None:
    assert main([*words, "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert len(told.strip().splitlines()) == 1
    assert message in told


def test_nothing_run_is_said_to_be_so(tmp_path: Path, capsys) -> None:
    assert main([OKELLY, "--at-most", "0", "--out", str(tmp_path), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["findings"] == []
    assert all(value["ours"] is None for table in record["tables"] for value in table["values"])
    assert "Made: 0 of" in record["notes"][1]
    assert "not run" in (tmp_path / "reproduction.md").read_text()


@pytest.mark.parametrize(
    ("held", "new", "said"),
    [
        (TIAN_RUNS, HIGHWAY_RUNS, "holds tian2024, replications 5, seed 0; this is okelly2018, ego lidar, scale small"),
        (HIGHWAY_RUNS, TIAN_RUNS, "holds okelly2018, ego lidar, scale small, seed 2018; this is tian2024,"),
        (TIAN_RUNS, TianPlan(5, seed=1).identity, "this is tian2024, replications 5, seed 1: choose another --out"),
        (HIGHWAY_RUNS, HighwayStudy("vision", "full").identity, "this is okelly2018, ego vision, scale full,"),
        (None, TIAN_RUNS, "holds runs of another command or version; this is tian2024"),
    ],
)
def test_another_paper_seed_scale_or_ego_is_refused(tmp_path: Path, held: dict, new: dict, said: str) -> None:
    """So is a file of another command; none, an empty folder and a torn first line are taken."""
    check_folder(tmp_path / "none", new)
    check_folder(tmp_path, new)
    file = tmp_path / "runs.jsonl"
    file.write_text('{"study": {"paper": "okel')
    check_folder(tmp_path, new)
    for line in [json.dumps({"study": held})] if held else ['{"rare_envs": "0.1.0"}', "[1]", "no JSON", "{}"]:
        file.write_text(line + '\n{"p": 1e-3}\n')
        with pytest.raises(BadInput, match=said) as caught:
            check_folder(tmp_path, new)
        assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def record_by_hand() -> dict[str, Any]:
    row = ("SS", "IDM")
    values = [
        compare(row, "mean of p", 8e-4, ours=6e-4, reasons=("traffic",)),
        compare(row, "simulations", ours=4980, interval=(4900.0, 5100.0), ours_all_in=5500),
        compare(("MC", "IDM"), "mean of p", 8.36e-4, released="does <not> run"),
    ]
    explanations = {"traffic": "Other roads, see `maps`.", "maps": "None.", "chance": "Unused."}
    return make_record(
        {"scale": "small", "seed": 3},
        title="A paper",
        source="Somebody, 2024.",
        command="python -m benchmarks.papers paper",
        tables=[make_table("table9", "Table IX: a table.", ("method", "system"), values, explanations)],
        figures={"figure9": {"title": "Figure 9.", "caption": "A line.", "paper": "Another line.", "y": [0.0, 1.0]}},
        findings=[find("A < B", "A / B", "holds", 0.5, (0.4, 0.6))],
        notes=["Counted."],
        runs=[{"p": float("nan")}],
    )


def test_a_record_says_what_made_it_and_is_written(tmp_path: Path) -> None:
    record = record_by_hand()
    assert record["about"]["rare_envs"] == rare_envs.__version__
    assert {"torch", "numba", "numpy", "processor", "scale", "seed"} <= set(record["about"])
    assert record["tables"][0]["values"][0]["difference"] == 6e-4 / 8e-4 - 1
    assert set(record["tables"][0]["explanations"]) == {"traffic", "maps"}
    write_record(tmp_path, record, {"figure9": (lambda drawing: drawing.subplots().plot([0.0, 1.0]), (3, 2))})
    assert json.loads((tmp_path / "reproduction.json").read_text()) == record
    assert (tmp_path / "figure9.png").stat().st_size > 1000
    lines = (tmp_path / "reproduction.md").read_text().splitlines()
    assert lines == format_record(record).splitlines()
    assert lines[0] == "## A paper"
    assert "| SS | IDM | 8.00e-04 / 6.00e-04 | – / 4,980 (4,900 to 5,100) | – / 5,500 |" in lines
    assert "- MC, IDM: mean of p: the released code: does <not> run" in lines
    assert "| A < B | A / B | 0.5 | 0.4 to 0.6 | holds |" in lines
    assert "- *traffic*: Other roads, see `maps`." in lines
    assert "- Figure 9. A line. In the paper: Another line." in lines
    assert {line.count("|") for line in lines if line.startswith("|")} == {6}


@pytest.fixture(scope="module")
def tian() -> dict[str, Any]:
    return read("tian2024")


def read_replications(record: dict[str, Any]) -> list[Run]:
    """Return the replications of a record, as far as it has them: no traces, no texts of warnings."""
    return [
        {
            **{name: group[name] for name in ROW_COLUMNS},
            **{name: math.nan if group[name][place] is None else group[name][place] for name in RUN_COLUMNS},
            **{name: [] for name in FURTHER_COLUMNS},
            "warnings": [""] * count,
        }
        for group in record["runs"]
        for place, count in enumerate(group["warnings"])
    ]


def runs_of(record: dict[str, Any], *row: str) -> dict[str, Any]:
    (found,) = (runs for runs in record["runs"] if (runs["scenario"], runs["system"], runs["method"]) == row)
    return found


def test_committed_records_follow_from_their_own_runs(tian) -> None:
    """What rests on the traces of runs, which a record of Tian et al. has not, is left out."""
    plan = TianPlan(tian["about"]["replications"], int(tian["about"]["seeds"].partition(" ")[0]))
    anew = to_json_value(record_replications(plan, read_replications(tian), tian["command"]))
    for name in ("title", "source", "command", "notes", "tables", "runs"):
        assert_same(anew[name], tian[name], name)
    assert_same(anew["figures"]["figure8"]["ends"], tian["figures"]["figure8"]["ends"])
    for paper in ("okelly2018", "okelly2018_full", "okelly2018_vision"):
        record = read(paper)
        about, (details,) = record["about"], record["runs"]
        study = HighwayStudy(about["ego"], about["scale"], about["seed"])
        again = make_okelly_record(study, record["command"], {**details, "findings": record["findings"]})
        assert_same({**again, "about": about}, record, paper)


@pytest.mark.parametrize(
    ("scenario", "method", "place"),
    [("car-following", "IS", 0), ("car-following", "SS", 7), ("cut-in", "ADSS", 19), ("cut-in", "cross-entropy", 3)],
)
def test_a_cheap_run_made_again_gives_the_committed_value(tian, scenario: str, method: str, place: int) -> None:
    runs = runs_of(tian, scenario, "IDM", method)
    with use_one_thread():
        again = run_replication(ReplicationJob(scenario, "IDM", method, runs["seed"][place]))
    assert again["p"] == pytest.approx(runs["p"][place], rel=1e-6)
    assert [again[name] for name in ("n_sim", "simulated")] == [runs[name][place] for name in ("n_sim", "simulated")]


def test_the_committed_record_has_the_replications_that_it_says(tian) -> None:
    assert {len(runs["p"]) for runs in tian["runs"]} == {tian["about"]["replications"]}
    assert tian["about"]["replications"] >= 20
    for runs in tian["runs"]:
        assert all(made >= stated for made, stated in zip(runs["simulated"], runs["n_sim"], strict=True))
