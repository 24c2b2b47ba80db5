from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

from rare_envs.study import BadInput
from rare_envs.study.cli.options import EVERYTHING
from rare_envs.study.question_file import KEYS, read_question_file

Cli = Callable[..., Result]


def test_the_same_question_as_a_file_gives_the_same_answer(cli: Cli, risky: str, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(f"env: rare_envs/CarFollowing-v0\nbase: {risky}\nmethod: mc\nmax-sim: 200\nseed: 3\nnoise: off\n")
    words = ("--base", risky, "--method", "mc", "--max-sim", 200, "--seed", 3, "--noise", "off", "--json")
    typed = json.loads(cli("estimate", "rare_envs/CarFollowing-v0", *words).stdout)
    filed = json.loads(cli("estimate", "--config", file, "--json").stdout)
    assert {**filed, "seconds": 0} == {**typed, "seconds": 0}
    assert filed["question"]["max_sim"] == 200 and filed["p"] > 0


def test_numbers_are_those_of_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text("env: a\nmax-p: 1e-4\ngamma: -1.5E+1\nhorizon: 3\nseed: 010\nmax-sim: 6000\nnoise: off\n")
    numbers = {"max_p": 1e-4, "gamma": -15.0, "horizon": 3, "seed": 10, "max_sim": 6000, "noise": False}
    assert read_question_file(file) == {"env_id": "a", **numbers}


def test_whole_numbers_may_have_an_exponent(cli: Cli, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text("env: rare_envs/CutIn-v0\nmax-sim: 1e6\nseed: 2e0\nchunk: 1.0\nworkers: 2e0\ngamma: 1e0\n")
    read = read_question_file(file)
    numbers = [read[name] for name in ("max_sim", "seed", "chunk", "workers", "gamma")]
    assert numbers == [1_000_000, 2, 1, 2, 1.0] and [type(number) for number in numbers] == [*[int] * 4, float]
    for text in ("max-sim: 1e-1", "max-sim: 100.5", "max-sim: 1e400", "seed: .nan"):
        file.write_text(f"env: rare_envs/CutIn-v0\n{text}\n")
        result = cli("estimate", "--config", file)
        assert result.exit_code == 2 and "to be a whole number" in result.stderr and result.stderr.count("\n") == 1


def test_the_keys_are_called_as_the_options(cli: Cli, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text("env: a\nconfidence: 0.9\nmax-p: 0.5\nworkers: 3\nexecutor: local\ntime-limit: 60\n")
    read = read_question_file(file)
    assert read == {
        "env_id": "a", "gate_confidence": 0.9, "max_p": 0.5, "workers": 3, "executor": "local", "time_limit": 60
    }  # fmt: skip
    for text, message in (
        ("env: rare_envs/CutIn-v0\nworkers: 0\n", "workers"),
        ("env: rare_envs/CutIn-v0\nworkers: many\n", "Expected workers to be a whole number or null, got 'many'"),
        ("env: rare_envs/CutIn-v0\nexecutor: cloud\n", "executor to be local or ray, got 'cloud'"),
        ("env: rare_envs/CutIn-v0\nconfidence: 0.9\n", "Expected --confidence together with --max-p"),
        ("env: rare_envs/CutIn-v0\nconfidense: 0.9\n", "did you mean 'confidence'"),
    ):
        file.write_text(text)
        result = cli("estimate", "--config", file)
        assert result.exit_code == 2 and message in result.stderr and result.stderr.count("\n") == 1


def test_what_is_typed_comes_before_the_file(cli: Cli, risky: str, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(f"env: rare_envs/Nowhere-v0\nbase: {risky}\nmethod: mc\nmax_sim: 200\nseed: 3\n")
    words = ("rare_envs/CarFollowing-v0", "--config", file, "--seed", 0, "--json")
    question = json.loads(cli("estimate", *words).stdout)["question"]
    assert (question["env_id"], question["seed"], question["max_sim"]) == ("rare_envs/CarFollowing-v0", 0, 200)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("env: rare_envs/CutIn-v0\nmax_sims: 3\n", r"unknown key 'max_sims' \(did you mean 'max_sim'\?\)"),
        ("env: rare_envs/CutIn-v0\nseed: 1\nseed: 2\n", "has the key 'seed' more than once"),
        ("env: rare_envs/CutIn-v0\ntrust: true\n", "cannot say trust: give --trust on the command line"),
        ("env: rare_envs/CutIn-v0\ngamma: low\n", "Expected gamma to be a number, got 'low'"),
        ("env: rare_envs/CutIn-v0\nseed: 1.5\n", "Expected seed to be a whole number"),
        ("env: rare_envs/CutIn-v0\nhorizon: 12:30\n", "Expected horizon to be a number or null, got '12:30'"),
        ("max-sim: 3\nmax_sim: 4\n", "same option twice"),
        ("- 1\n- 2\n", "lines like gamma"),
        ("", "has no keys: expected lines like gamma"),
        ("env: [unclosed\n", "is no YAML"),
        ("env: !!python/object/apply:os.system ['true']\n", "is no YAML"),
        ("1: 2\n", "lines like gamma"),
        ("seed: 2000-99-99\n", "is no YAML|Expected seed"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_one_line(cli: Cli, tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(text)
    with pytest.raises(BadInput, match=message):
        read_question_file(file)
    result = cli("estimate", "--config", file)
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and "Traceback" not in result.stderr


def test_no_environment_and_no_file_are_refused(cli: Cli, tmp_path: Path) -> None:
    assert "Expected an environment" in cli("estimate").stderr
    assert "Cannot read" in cli("estimate", "--config", tmp_path / "none.yaml").stderr


def test_every_option_can_be_in_a_file() -> None:
    assert set(EVERYTHING) <= {field.name for field in KEYS.values()}
