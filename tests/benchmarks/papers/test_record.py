"""Records say what made them; a folder belongs to one reproduction, and others are refused in a line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import rare_envs
from benchmarks.papers.okelly2018.study import HighwayStudy
from benchmarks.papers.record import (
    ComparedValue,
    ComparisonTable,
    DrawnFigure,
    check_reproduction_folder,
    discard_runs,
    write_record,
)
from benchmarks.papers.tian2024.study import TianPlan
from rare_envs.study.errors import BadInput
from tests.benchmarks.papers.records import record_by_hand

TIAN, HIGHWAY = TianPlan(5).identity, HighwayStudy().identity


def write_runs(folder: Path, study: dict, name: str = "runs.jsonl") -> Path:
    file = folder / name
    file.write_text(json.dumps({"study": study}) + '\n{"p": 1e-3}\n')
    return file


@pytest.mark.parametrize(
    ("held", "new", "said"),
    [
        (TIAN, HIGHWAY, "holds tian2024, replications 5, seed 0; this is okelly2018, ego lidar, scale small, seed"),
        (HIGHWAY, TIAN, "holds okelly2018, ego lidar, scale small, seed 2018; this is tian2024, replications 5, seed"),
        (TIAN, TianPlan(5, seed=1).identity, "seed 0; this is tian2024, replications 5, seed 1: choose another --out"),
        (TIAN, TianPlan(20).identity, "replications 5, seed 0; this is tian2024, replications 20, seed 0"),
        (TIAN, TianPlan(5, monte_carlo=2).identity, "this is tian2024, replications 5, of Monte Carlo 2, seed 0"),
        (HIGHWAY, HighwayStudy("vision").identity, "this is okelly2018, ego vision,"),
        (HIGHWAY, HighwayStudy(scale="full").identity, "scale full"),
        (HIGHWAY, HighwayStudy(seed=1).identity, "seed 1"),
    ],
)
def test_another_paper_seed_scale_or_ego_is_refused(tmp_path: Path, held: dict, new: dict, said: str) -> None:
    write_runs(tmp_path, held)
    check_reproduction_folder(tmp_path, held)
    with pytest.raises(BadInput, match=said) as caught:
        check_reproduction_folder(tmp_path, new)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("line", ['{"rare_envs": "0.1.0"}\n', "[1]\n", "no JSON\n", "{}\n"])
def test_files_of_other_commands_are_refused(tmp_path: Path, line: str) -> None:
    (tmp_path / "own.jsonl").write_text(line)
    with pytest.raises(BadInput, match="holds runs of another command or version; this is tian2024"):
        check_reproduction_folder(tmp_path, TIAN)


def test_folders_without_runs_are_taken(tmp_path: Path) -> None:
    """None, an empty one, and one whose first line a stop has cut off."""
    check_reproduction_folder(tmp_path / "none", TIAN)
    check_reproduction_folder(tmp_path, TIAN)
    (tmp_path / "runs.jsonl").write_text('{"study": {"paper": "okel')
    check_reproduction_folder(tmp_path, TIAN)


def test_runs_of_another_paper_are_not_deleted(tmp_path: Path) -> None:
    others = [write_runs(tmp_path, HIGHWAY, "a.jsonl"), tmp_path / "b.jsonl"]
    others[1].write_text('{"rare_envs": "0.1.0"}\n')
    for file in others:
        discard_runs(file, "tian2024")
        assert file.exists()
    own = write_runs(tmp_path, TIAN)
    discard_runs(own, "tian2024")
    discard_runs(own, "tian2024")
    assert not own.exists()


def test_a_record_says_what_made_it_and_is_written(tmp_path: Path) -> None:
    record = record_by_hand()
    assert record["about"]["rare_envs"] == rare_envs.__version__
    assert {"torch", "numba", "numpy", "processor", "scale", "seed"} <= set(record["about"])
    assert record["tables"][0]["values"][0]["difference"] == 6e-4 / 8e-4 - 1
    write_record(
        tmp_path, record, [DrawnFigure("figure9", lambda drawing: drawing.subplots().plot([0.0, 1.0]), (3, 2))]
    )
    assert json.loads((tmp_path / "reproduction.json").read_text()) == record
    assert "8.00e-04" in (tmp_path / "reproduction.md").read_text()
    assert (tmp_path / "figure9.png").stat().st_size > 1000


def test_a_table_has_the_labels_and_reasons_that_it_names() -> None:
    value = ComparedValue(labels=("x",), quantity="p", reasons=("traffic",))
    with pytest.raises(ValueError, match="Expected 2 labels"):
        ComparisonTable(name="t", title="t", keys=("a", "b"), values=(value,))
    with pytest.raises(ValueError, match="No explanation 'traffic'"):
        ComparisonTable(name="t", title="t", keys=("a",), values=(value,))
