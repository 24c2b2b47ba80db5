"""Folders of somebody else: nothing that they name runs without trust, damaged ones are one line, moved files found."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from rare_envs.study import BadInput, Question, prepare, run_into
from rare_envs.study.evaluate import resume
from rare_envs.study.question import digest_files, find_changed_files, is_same_question, list_code, open_question
from rare_envs.study.replay import find_failure
from rare_envs.study.run_folder import RESULT
from rare_envs.study.writing import begin_journal
from tests.rare_envs.study.refusals import FOLLOWING

EVIL = """
from pathlib import Path

Path("was_here").touch()

import numpy as np


class Coasting:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), np.float32), None


def make():
    return Coasting()


def gap(moment):
    return moment.lead.gap
"""
CODE = {
    "ego": {"ego": "evil:make"},
    "ego behind a stack and in a process": {"ego": "noisy:process:evil:make?timeout=5"},
    "measure": {"measure": "evil:gap"},
    "environment": {"env_id": f"evil:{FOLLOWING}"},
}


def test_the_address_of_an_ego_elsewhere_may_change_and_other_egos_may_not() -> None:
    for ego, other, same in (("tcp://a:1", "tcp://b:2", True), ("idm", "human", False)):
        asked = Question(env_id=FOLLOWING, ego=ego)
        assert is_same_question(asdict(replace(asked, ego=other)), asked) is same
    assert is_same_question(asdict(replace(asked, core="numba", trust=True, on_error="failure")), asked)
    assert not is_same_question(asdict(replace(asked, seed=1)), asked)
    assert not is_same_question(None, asked)


@pytest.fixture
def received(finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder from somebody else, with a module of theirs, in the working directory of one who made no runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "evil.py").write_text(EVIL)
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def change_question(folder: Path, **changes: Any) -> dict[str, Any]:
    result = json.loads((folder / RESULT).read_text())
    result["question"] = {**result["question"], **changes}
    (folder / RESULT).write_text(json.dumps(result))
    return dict(result["question"])


@pytest.mark.parametrize("name", CODE)
def test_a_received_run_is_neither_replayed_nor_resumed_without_trust(name: str, received: Path) -> None:
    question = Question(**change_question(received, **CODE[name]))
    Path("begun").mkdir()
    begin_journal(Path("begun"), question).close()
    for act in (lambda: find_failure(received, 0), lambda: resume(Path("begun"))):
        with pytest.raises(BadInput, match=r"was not made here, and its question runs code: 'evil:.*add --trust"):
            act()
    assert not Path("was_here").exists()


@pytest.mark.filterwarnings("ignore:.*changed since the run")  # the folder is that of another ego
def test_trust_is_asked_for_each_time(received: Path) -> None:
    change_question(received, ego="evil:make")
    assert find_failure(received, 0, trust=True).n_found > 0
    assert Path("was_here").exists()
    with pytest.raises(BadInput, match="add --trust"):
        find_failure(received, 0)


def test_a_run_of_ones_own_needs_no_trust(received: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    question = Question(env_id=FOLLOWING, ego="evil:make", base="us101-gap", method="mc", max_sim=200, gamma=5.0)
    run_into(tmp_path / "mine", prepare(question))
    with Path("evil.py").open("a") as file:
        file.write("\nmended = True\n")
    with pytest.warns(UserWarning, match=r"evil\.py changed since the run in .*mine' was begun"):
        assert find_failure(tmp_path / "mine", 0).n_found > 0
    Path("elsewhere").mkdir()
    shutil.copy("evil.py", "elsewhere")
    monkeypatch.chdir("elsewhere")  # a module of the same name, which is not that of the run
    with pytest.raises(BadInput, match="add --trust"):
        find_failure(tmp_path / "mine", 0)


@pytest.mark.filterwarnings("ignore:.*changed since the run")  # a base in the place of a file
def test_odd_questions_are_refused_in_one_line(received: Path) -> None:
    for change, words in (
        ({"seed": True}, "seed of the recorded question to be a whole number, got True"),
        ({"env_id": [FOLLOWING]}, "env_id of the recorded question to be a text"),
        ({"gamma": 10**400}, "401 digits"),
        ({"base": "/dev/null"}, ""),
        ({"measure": "stl:" + "not " * 50_000}, ""),
    ):
        before = (received / RESULT).read_text()
        change_question(received, **change)
        with pytest.raises(BadInput) as caught:
            find_failure(received, 0)
        said = str(caught.value)
        assert words in said and "\n" not in said and len(said) < 2000
        (received / RESULT).write_text(before)


def test_values_of_every_field_are_taken_back_and_what_is_no_code_is_not_listed(received: Path) -> None:
    question = Question(env_id=FOLLOWING, gamma=1, max_sim=None, noise="fixed", horizon=3.0, trust=True)
    recorded = json.loads(json.dumps(asdict(question)))
    assert open_question({**recorded, "unknown": 1}, received, trust=True) == question
    for ego in ("idm", "ego.zip", "noisy:gail", "tcp://127.0.0.1:5555", "process:imitation?timeout=3"):
        assert list_code(Question(env_id=FOLLOWING, ego=ego)) == []


@pytest.mark.parametrize("name", ["vecnormalize.pkl", "mine.pkl"])
def test_statistics_of_an_ego_are_part_of_it(name: str, here: Path) -> None:
    (here / "ego.zip").write_bytes(b"weights")
    question = Question(env_id="", ego="noisy:ego.zip", stats="mine.pkl" if name == "mine.pkl" else None)
    states = [digest_files(question)]
    for content in (b"one", b"two"):
        (here / name).write_bytes(content)
        states.append(digest_files(question))
    bare, one, two = states
    assert find_changed_files(one, two) == find_changed_files(bare, one) == find_changed_files(one, bare) == [name]
