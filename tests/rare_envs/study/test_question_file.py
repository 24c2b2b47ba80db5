"""The question as a YAML file, by the same names as the options."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from rare_envs.study import BadInput
from rare_envs.study.arguments import KEYS, list_arguments, read_question_file
from rare_envs.study.cli.options import EVERYTHING
from tests.rare_envs.study.refusals import Cli


def test_the_same_question_as_a_file_gives_the_same_answer(cli: Cli, risky: str, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(f"env: rare_envs/CarFollowing-v0\nbase: {risky}\nmethod: mc\nmax-sim: 200\nseed: 3\nnoise: off\n")
    words = ("--base", risky, "--method", "mc", "--max-sim", 200, "--seed", 3, "--noise", "off", "--json")
    typed = json.loads(cli("estimate", "rare_envs/CarFollowing-v0", *words).stdout)
    filed = json.loads(cli("estimate", "--config", file, "--json").stdout)
    assert {**filed, "seconds": 0} == {**typed, "seconds": 0}
    assert filed["question"]["max_sim"] == 200 and filed["p"] > 0
    changed = cli("estimate", "rare_envs/CarFollowing-v0", "--config", file, "--seed", 0, "--json")
    question = json.loads(changed.stdout)["question"]
    assert (question["env_id"], question["seed"], question["max_sim"]) == ("rare_envs/CarFollowing-v0", 0, 200)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("max-p: 1e-4\ngamma: -1.5E+1\nhorizon: 3\n", {"max_p": 1e-4, "gamma": -15.0, "horizon": 3.0}),
        ("seed: 010\nmax-sim: 1e6\nchunk: 1.0\n", {"seed": 10, "max_sim": 10**6, "chunk": 1}),
        ("noise: off\nweather: yes\n", {"noise": False, "weather": True}),
        ("noise: fixed\nego: on\nbase: null\n", {"noise": "fixed", "ego": "on", "base": None}),
        ("base: 'null'\n", {"base": "null"}),
        ("confidence: 0.9\nworkers: 2e0\ntime-limit: 60\n", {"gate_confidence": 0.9, "workers": 2, "time_limit": 60.0}),
        ('{"env": "a", "seed": 3}', {"seed": 3}),
    ],
)  # fmt: skip
def test_values_are_of_the_types_of_their_fields(tmp_path: Path, text: str, values: dict[str, object]) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(text if text.startswith("{") else f"env: a\n{text}")
    read = read_question_file(file)
    assert read == {"env_id": "a", **values}
    assert {name: type(value) for name, value in values.items()} == {name: type(read[name]) for name in values}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("max_sims: 3\n", r"unknown key 'max_sims' \(did you mean 'max_sim'\?\)"),
        ("seed: 1\nseed: 2\n", "has the key 'seed' more than once"),
        ("trust: true\n", "cannot say trust: give --trust on the command line"),
        ("gamma: low\n", "Expected gamma to be a number, got 'low'"),
        ("seed: 1.5\n", "Expected seed to be a whole number"),
        ("max-sim: 1e400\n", "to be a whole number"),
        ("horizon: 12:30\n", "Expected horizon to be a number or null, got '12:30'"),
        ("max-sim: 3\nmax_sim: 4\n", "same option twice"),
        ("base: !!python/object/apply:os.system ['true']\n", "lines like gamma"),
        ("base: [unclosed\n", "is no YAML"),
        ("1: 2\n", "unknown key '1'"),
        ("seed: 2000-99-99\n", "Expected seed to be a whole number, got '2000-99-99'"),
        ("workers: 0\n", "workers"),
        ("executor: cloud\n", "executor to be local or ray, got 'cloud'"),
        ("confidence: 0.9\n", "Expected --confidence together with --max-p"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_one_line(cli: Cli, tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(f"env: rare_envs/CutIn-v0\n{text}")
    result = cli("estimate", "--config", file)
    assert result.exit_code == 2 and result.stderr.count("\n") == 1
    assert re.search(message, result.stderr)


def test_no_keys_no_environment_and_no_file_are_refused(cli: Cli, tmp_path: Path) -> None:
    for text, message in (("- 1\n- 2\n", "lines like gamma"), ("", "has no keys: expected lines like gamma")):
        (tmp_path / "study.yaml").write_text(text)
        with pytest.raises(BadInput, match=message):
            read_question_file(tmp_path / "study.yaml")
    assert "Expected an environment" in cli("estimate").stderr
    assert "Cannot read" in cli("estimate", "--config", tmp_path / "none.yaml").stderr


def test_every_option_can_be_in_a_file_and_is_in_the_table() -> None:
    assert set(EVERYTHING) <= {field.name for field in KEYS.values()}
    assert all(f"| `{key}` |" in list_arguments() for key in KEYS)
