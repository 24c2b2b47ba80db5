"""Faults of an ego on the command line: counted as asked for, and listed."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

Cli = Callable[..., Result]
SMALL = ("estimate", "rare_envs/CarFollowing-v0", "--method", "mc", "--max-sim", 400)


@pytest.mark.parametrize(
    ("ego", "reason"), [("nan_when_close", "NaN or infinite"), ("exiting_when_close", "SystemExit(7)")]
)
def test_scenarios_on_which_the_ego_fails_are_listed(cli: Cli, here: Path, risky: str, ego: str, reason: str) -> None:
    words = (*SMALL, "--base", risky, "--ego", f"egos_here:{ego}", "--out", here / "run")
    found = {}
    for on_error in ("bound", "failure"):
        result = cli(*words, "--on-error", on_error)
        assert result.exit_code == 3, result.output  # the number is doubtful
        found[on_error] = json.loads((here / "run" / "result.json").read_text())
        assert f"the ego failed twice on {found[on_error]['n_faults']} scenarios" in result.stdout
    with (here / "run" / "faults.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    answer = found["failure"]
    assert header == ["ego_speed", "lead_speed", "gap", "reason"]
    assert len(rows) == answer["n_faults"] == answer["n_failures"] > 10  # this ego fails before it collides
    assert all(reason in row[-1] for row in rows)
    assert answer["n_retried"] >= len(rows)
    assert answer["faults"][0]["parameters"]["gap"] == float(rows[0][2])
    assert answer["p"] == pytest.approx(len(rows) / 400)
    assert found["bound"]["interval"][0] == 0.0
    assert found["bound"]["interval"][1] == answer["interval"][1]
    assert np.isfinite(np.array([row[:-1] for row in rows], dtype=float)).all()
    assert cli(*SMALL, "--ego", "idm", "--out", here / "run").exit_code in (0, 3)
    assert not (here / "run" / "faults.csv").exists()


def test_an_unknown_word_is_refused(cli: Cli) -> None:
    result = cli(*SMALL, "--on-error", "bonud")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "Did you mean 'bound'" in result.stderr


def test_an_ego_that_answers_differently_each_time_is_noticed(cli: Cli, here: Path) -> None:
    (here / "restless.py").write_text(
        "import egos_here\n"
        "import numpy as np\n"
        "def make():\n"
        "    ego = egos_here.Ego()\n"
        "    ego.choose = lambda observation: np.random.uniform(-1, 1, (len(observation), 2))\n"
        "    return ego\n"
    )
    words = (*SMALL[:-1], 50, "--json", "--gamma", 5, "--ego")
    for ego in ("restless:make", "noisy:restless:make"):
        found = json.loads(cli(*words, ego).stdout)
        assert "failures may not replay" in found["given"]
        assert found["n_failures"] > 0
        assert found["kinds"] == {}
        assert "cannot be seen again" in " ".join(found["notes"])
    assert json.loads(cli(*words, "egos_here:coasting").stdout)["given"] == ""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["idm"], "needs more than observations"),
        (["egos_here:coasting", "--bind", "tcp://*:5555"], "set a shared secret"),
        (["egos_here:coasting", "--bind", "tcp://127.0.0.1:port"], "Cannot listen"),
        (["nowhere.zip"], "nowhere.zip"),
    ],
)
def test_an_ego_that_cannot_be_served_is_one_line(cli: Cli, here: Path, words: list[str], said: str) -> None:
    result = cli("serve-ego", *words)
    assert (result.exit_code, result.stdout) == (2, "")
    assert said in result.stderr
    assert result.stderr.count("\n") == 1
