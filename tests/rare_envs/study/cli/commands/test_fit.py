"""The command `fit`: options, files and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import training.fit.recordings as fitting
from tests.rare_envs.study.refusals import Cli, assert_refused


def test_the_files_that_were_written_are_the_answer(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: dict[str, Any] = {}
    file = tmp_path / "cut_in_own.json"

    def fit(recordings: Any, out: Path, **options: Any) -> list[Path]:
        asked.update(options, kind=recordings.kind_and_path()[0], between=recordings.between)
        print("progress")
        return [out / file.name]

    monkeypatch.setattr(fitting, "fit_bases", fit)
    words = ("--i24", "morning.json", "--between", 1, 2, "--scenario", "cut_in", "--refits", 3, "--out", tmp_path)
    answer = cli("fit", *words, "--json")
    assert json.loads(answer.stdout) == {"bases": [str(file)]}
    assert "progress" in answer.stderr
    given = {"kind": "i24", "between": (1.0, 2.0), "scenarios": ["cut_in"], "n_refits": 3}
    assert asked == {**given, "cut_gaps": False, "name": "own", "seed": 0, "progress": True}
    assert cli("fit", *words).stdout == f"{file}: rare-envs estimate ENV --base {file}\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "Expected one of --data, --ngsim"),
        (("--highd", "a", "--tgsim", "b"), "Expected one of --data, --ngsim"),
        (("--highd", "nowhere"), "nowhere"),
        (("--highd", "a", "--scenario", "overtaking"), "Unknown scenario overtaking"),
        (("--highd", "a", "--name", "a/b"), "Expected --name"),
    ],
)
def test_bad_input_is_one_line(cli: Cli, here: Path, words: tuple[str, ...], said: str) -> None:
    assert_refused(cli("fit", "--out", "bases", *words), said)
    assert not list(here.glob("bases/*"))
