"""Records: plain values, with what made them."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import pytest

import rare_envs
from rare_envs.study.html_report.svg import FigureOfPage
from rare_envs.study.reproduction.record import digest_code, write_record
from tests.rare_envs.study.reproduction.records import record_by_hand


def test_another_source_or_weight_is_other_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def digest(**files: str) -> str:
        for name, text in files.items():
            (tmp_path / name.replace("_", ".")).write_text(text)
        digest_code.cache_clear()
        return digest_code()

    shipped = digest()
    monkeypatch.setattr(resources, "files", lambda package: tmp_path)
    found = [digest(a_py="1"), digest(a_py="2"), digest(b_safetensors="w"), digest(notes_txt="t")]
    digest_code.cache_clear()
    assert len({shipped, *found[:3]}) == 4
    assert found[3] == found[2]


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
