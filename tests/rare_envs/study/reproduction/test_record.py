"""Records: plain values, with what made them."""

from __future__ import annotations

import json
from pathlib import Path

import rare_envs
from rare_envs.study.html_report.svg import FigureOfPage
from rare_envs.study.reproduction.record import write_record
from tests.rare_envs.study.reproduction.records import record_by_hand


def test_a_record_says_what_made_it() -> None:
    record = record_by_hand()
    assert record["about"]["rare_envs"] == rare_envs.__version__
    assert {"torch", "numba", "numpy", "processor", "scale", "seed"} <= set(record["about"])
    assert record["tables"][0]["values"][0]["difference"] == 6e-4 / 8e-4 - 1
    assert record["runs"] == [{"p": None}]


def test_file_and_page_are_written(tmp_path: Path) -> None:
    record = record_by_hand()
    figure = FigureOfPage("figure9", "A line.", lambda drawing: drawing.subplots().plot([0.0, 1.0]), (3, 2))
    paths = write_record(tmp_path, record, [figure])
    assert [path.name for path in paths] == ["reproduction.json", "reproduction.html"]
    assert json.loads(paths[0].read_text()) == record
    assert "<svg" in paths[1].read_text()
