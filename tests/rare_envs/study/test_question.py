"""Questions, checked before the first simulation."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import agents
import rare_envs
from rare_envs.egos.needs import EgoWarning
from rare_envs.study import BadInput, Question, prepare
from rare_envs.study.arguments import KEYS, list_arguments, read_question_file
from rare_envs.study.ego_check import run_checks
from rare_envs.study.probe import Finding
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused, in_file

STRICT = """
import numpy as np, egos_here

np.seterr(all="raise")
act = egos_here.made(lambda seen: np.seterr(all="raise") and egos_here.still(seen))
make = lambda: np.seterr(all="raise") and act()
"""


def test_what_actions_are_taken_for_is_pointed_out(cli: Cli, here: Path) -> None:
    """A policy from HighwayEnv without its meta-actions runs all the same, and behaves arbitrarily."""
    few = ("--method", "mc", "--max-sim", 50, "--gamma", 1)  # TTC < 1 s has no rate, and so no notes on one
    words = ("estimate", FOLLOWING, "--ego", "egos_here:idle", *few, "--json")
    kinematics = ("--observation", "kinematics")
    (note,) = json.loads(cli(*words, *kinematics, "--action", "continuous").stdout)["notes"]
    assert "--action meta" in note
    for more in ((*kinematics, "--action", "meta"), ("--action", "discrete")):
        assert json.loads(cli(*words, *more).stdout)["notes"] == []
    assert_refused(cli(*words, *kinematics), "fit two kinds", "--action meta", "--action discrete")
    (accelerating,) = json.loads(cli(*words).stdout)["notes"]
    assert "--action discrete" in accelerating
    asked = Question(env_id=FOLLOWING, ego="egos_here:idle", observation="kinematics", action="continuous")
    (found,) = (each for each in run_checks(asked) if isinstance(each, Finding) and each.found == note)
    assert (found.check, found.status) == ("action space", "warn")
    with pytest.warns(EgoWarning, match="--action meta"):
        ego = agents.load_ego("egos_here:idle")
        rare_envs.DrivingProblem(FOLLOWING, ego=ego, observation="kinematics", action="continuous")


def test_an_ego_that_answers_differently_each_time_is_noticed(cli: Cli, here: Path) -> None:
    words = (*SMALL[:-1], 50, "--json", "--gamma", 5, "--ego")
    for ego in ("egos_here:restless", "noisy:egos_here:restless"):
        found = json.loads(cli(*words, ego).stdout)
        assert "failures may not replay" in found["given"] and found["n_failures"] > 0 and found["kinds"] == {}
        assert "cannot be seen again" in " ".join(found["notes"])
    assert json.loads(cli(*words, "egos_here:coasting").stdout)["given"] == ""


def test_what_is_known_before_the_ego_is_loaded_is_checked_first() -> None:
    for name, wrong, said in (("method", "addss", "'adss'"), ("on_error", "bonud", "bound"), ("chunk", 0, "chunk")):
        with pytest.raises(BadInput, match=said):
            prepare(replace(Question(env_id=FOLLOWING, ego="nobody.zip"), **{name: wrong}))  # type: ignore[arg-type]


def test_a_threshold_that_nothing_or_only_collisions_reach_is_told() -> None:
    for measure, gamma in (("ttc", -1.5), ("drac", -1e6)):
        with pytest.raises(BadInput, match="cannot happen"):
            prepare(Question(env_id=FOLLOWING, measure=measure, gamma=gamma))
    with pytest.warns(UserWarning, match="counts collisions, as --gamma 0 does"):
        prepare(Question(env_id=FOLLOWING, gamma=-1.0))
    assert prepare(Question(env_id=FOLLOWING, measure="margin", gamma=-5.0)).question.gamma == -5.0


def test_an_ego_that_sets_numpys_errors_sets_them_for_itself(cli: Cli, here: Path, risky: str) -> None:
    (here / "strict.py").write_text(STRICT)
    before = np.geterr()
    words = ("--base", risky, "--max-sim", "2000", *in_file(horizon=2), "--gamma", "1", "--json")
    strict, usual = (cli("estimate", FOLLOWING, "--ego", ego, *words) for ego in ("strict:make", "egos_here:coasting"))
    assert strict.exit_code in (0, 3), strict.stderr
    assert json.loads(strict.stdout)["p"] == json.loads(usual.stdout)["p"]
    assert np.geterr() == before


def test_the_same_question_as_a_file_gives_the_same_answer(cli: Cli, risky: str, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(f"env: rare_envs/CarFollowing-v0\nbase: {risky}\nmethod: mc\nmax-sim: 200\nseed: 3\nnoise: off\n")
    words = ("--base", risky, "--method", "mc", "--max-sim", 200, "--seed", 3, *in_file(noise=False), "--json")
    typed = json.loads(cli("estimate", FOLLOWING, *words).stdout)
    filed = json.loads(cli("estimate", "--config", file, "--json").stdout)
    assert {**filed, "seconds": 0} == {**typed, "seconds": 0}
    assert filed["question"]["max_sim"] == 200 and filed["p"] > 0
    changed = json.loads(cli("estimate", "--config", file, "--seed", 0, "--json").stdout)["question"]
    assert (changed["env_id"], changed["seed"], changed["max_sim"]) == (FOLLOWING, 0, 200)


VALUES: tuple[tuple[str, dict[str, object]], ...] = (
    ("max-p: 1e-4\ngamma: -1.5E+1\nhorizon: 3\n", {"max_p": 1e-4, "gamma": -15.0, "horizon": 3.0}),
    ("seed: 010\nmax-sim: 1e6\nchunk: 1.0\n", {"seed": 10, "max_sim": 10**6, "chunk": 1}),
    ("noise: off\nweather: yes\n", {"noise": False, "weather": True}),
    ("noise: fixed\nego: on\nbase: null\n", {"noise": "fixed", "ego": "on", "base": None}),
    ("base: 'null'\n", {"base": "null"}),
    ("confidence: 0.9\nworkers: 2e0\ntime-limit: 60\n", {"confidence": 0.9, "workers": 2, "time_limit": 60.0}),
    ('{"env": "a", "seed": 3}', {"seed": 3}),
)


def test_values_are_of_the_types_of_their_fields(tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    for text, values in VALUES:
        file.write_text(text if text.startswith("{") else f"env: a\n{text}")
        read = read_question_file(file)
        assert read == {"env_id": "a", **values}
        assert {name: type(value) for name, value in values.items()} == {name: type(read[name]) for name in values}


UNUSABLE = (
    ("- 1\n- 2\n", "lines like gamma"),
    ("", "has no keys: expected lines like gamma"),
    ("max_sims: 3\n", r"unknown key 'max_sims' \(did you mean 'max_sim'\?\)"),
    ("seed: 1\nseed: 2\n", "has the key 'seed' more than once"),
    ("trust: true\n", "cannot say trust: give --trust on the command line"),
    ("seed: 1.5\n", "Expected seed to be a whole number"),
    ("max-sim: 1e400\n", "to be a whole number"),
    ("horizon: 12:30\n", "Expected horizon to be a number or null, got '12:30'"),
    ("max-sim: 3\nmax_sim: 4\n", "has the key 'max_sim' more than once"),
    ("base: !!python/object/apply:os.system ['true']\n", "Expected --base in '.*' to be one value"),
    ("seed: [1]\n", "Expected --seed in '.*' to be one value"),
    ("ego: null\n", "Expected ego to be a text, got None"),
    ("base: [unclosed\n", "is no YAML"),
)


def test_a_file_that_cannot_be_used_is_refused_in_one_line(cli: Cli, tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    for text, message in UNUSABLE:
        file.write_text(text if text.startswith("-") else f"env: rare_envs/CutIn-v0\n{text}" if text else "")
        result = cli("estimate", "--config", file)
        assert result.exit_code == 2 and result.stderr.count("\n") == 1
        assert re.search(message, result.stderr), text


def test_every_option_can_be_in_a_file_and_is_in_the_table() -> None:
    assert {field.name for field in fields(Question)} <= {field.name for field in KEYS.values()}
    assert all(f"| `{key}` |" in list_arguments() for key in KEYS)
