from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

from rare_envs.study import html_report as page

Cli = Callable[..., Result]


def test_options_reach_the_report_and_the_answer_names_the_files(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    def write(*words: object) -> list[Path]:
        asked.extend(words)
        return [Path("a.html"), Path("figures/curve.pdf")]

    monkeypatch.setattr(page, "write_html_report", write)
    words = ("report", "run", "--out", "a.html", "--events", "e.csv", "--figures", "pdf", "--trust")
    assert json.loads(cli(*words, "--json").stdout) == {"report": "a.html", "figures": ["figures/curve.pdf"]}
    assert asked == [Path("run"), True, Path("e.csv"), Path("a.html"), "pdf"]
    assert cli(*words).stdout == "Wrote a.html and 1 figures.\n"


def test_a_folder_without_a_run_is_refused_in_one_line(cli: Cli, tmp_path: Path) -> None:
    refused = cli("report", tmp_path)
    assert refused.exit_code == 2 and "No finished run" in refused.stderr and refused.stderr.count("\n") == 1
