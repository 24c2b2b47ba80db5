"""Folders of somebody else: nothing that they name runs without trust, damaged ones are one line, moved files found."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

import agents
import rare_envs
from rare_envs.files import digest_file
from rare_envs.problem import DrivingProblem
from rare_envs.study import BadInput, Question, prepare, run_into
from rare_envs.study.arguments import RunInterrupted, read_question
from rare_envs.study.compared_risks import compare_risks
from rare_envs.study.evaluate import resume
from rare_envs.study.html_report import write_html_report
from rare_envs.study.question import (
    digest_files,
    find_changed_files,
    is_same_question,
    list_risks,
    note_question,
    open_question,
    open_run,
)
from rare_envs.study.replay import find_failure
from rare_envs.study.run_folder import ANSWER, EPISODES, FAILURES, RESULT, RESULT_FILES, STUDY, load_study
from rare_envs.study.writing import begin_journal
from tests.rare_envs.study.refusals import FOLLOWING, Cli, act_after, assert_refused

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
    "ego with its file": {"ego": "evil:make?file=runs/a.pt"},
    "a driver with its file": {"drivers": "lead=evil:make?file=runs/a.pt"},
    "measure": {"measure": "evil:gap"},
    "environment": {"env_id": f"evil:{FOLLOWING}"},
    "a program elsewhere": {"ego": "noisy:tcp://127.0.0.1:9?timeout=1"},
    "the Hub": {"ego": "process:hf:user/ppo"},
    "drivers": {"drivers": "evil:make"},
    "a driver of one vehicle": {"drivers": "lead=evil:make"},
    "a driver in a process, behind another": {"drivers": "cutter=idm.zip,lead=process:evil:make?timeout=5"},
    "a driver elsewhere": {"drivers": "lead=tcp://127.0.0.1:9"},
    "a driver elsewhere whose address looks like a file": {"drivers": "tcp://127.0.0.1:9/a.zip"},
    "a driver of the Hub": {"drivers": "lead=hf:user/ppo"},
    "traffic model": {"base": "evil:make"},
    "another traffic model": {"also_under": "us101, evil:make"},
    "method": {"method": "evil:Coasting"},
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
    monkeypatch.delitem(sys.modules, "evil", raising=False)  # or another test's would not run again
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def change_question(folder: Path, **changes: Any) -> dict[str, Any]:
    result = json.loads((folder / RESULT).read_text())
    result["question"] = {**result["question"], **changes}
    (folder / RESULT).write_text(json.dumps(result))
    about = json.loads((folder / STUDY).read_text())
    about["results"][RESULT] = digest_file(folder / RESULT)  # as a sender would write it anew
    (folder / STUDY).write_text(json.dumps(about))
    return dict(result["question"])


@pytest.mark.parametrize("name", CODE)
def test_a_received_run_is_neither_replayed_nor_resumed_without_trust(name: str, received: Path) -> None:
    question = Question(**change_question(received, **CODE[name]))
    Path("begun").mkdir()
    begin_journal(Path("begun"), question).close()
    for act in (lambda: find_failure(received, 0), lambda: resume(Path("begun"))):
        words = r"was not made here, and its question (runs code: 'evil:|connects to .*: '(tcp|hf):).*add --trust"
        with pytest.raises(BadInput, match=words):
            act()
    assert not Path("was_here").exists()


@pytest.mark.parametrize("command", ["risk", "compare", "compare sums"])
@pytest.mark.parametrize("name", ["ego", "ego of B", "drivers", "base", "method", "measure", "also_under", "env_id"])
def test_what_a_received_sum_or_comparison_names_runs_no_code(
    command: str, name: str, received: Path, cli: Cli
) -> None:
    """The journals of sums ask nothing that needs trust: the arguments that they record do."""
    options: dict[str, Any] = {"method": "mc", "max_sim": 200}
    code = {"measure": "evil:gap", "env_id": "evil:rare_envs/HardBrake-v0"}.get(name, "evil:make")
    asked = Question(env_id="rare_envs/HardBrake-v0", base="us101", ego="idm", **options)
    sides = {"A": asked, "B": asked}
    egos = {"ego": "idm", "ego_a": "idm", "ego_b": "idm"}
    whole: dict[str, Any] = {"command": command, "scenarios": ["hard_brake"], "sites": ["us101"], "site": "us101"}
    whole |= {"bases": {}, "chunked": False, "options": options, "b": {"algo_b": None, "stats_b": None}}
    if command == "compare":
        side, field = ("B", "ego") if name == "ego of B" else ("A", name)
        sides[side], whole = replace(asked, **{field: code}), {"command": command}
    elif name in ("ego", "ego of B"):
        changed = {"ego": ["ego", "ego_a"], "ego of B": ["ego", "ego_b"]}[name]
        whole |= egos | dict.fromkeys(changed, code)
    else:
        whole |= egos | {"scenarios": [code]} if name == "env_id" else egos
        whole |= {"bases": {"HardBrake-v0": code}} if name == "base" else {}
        whole |= {"options": {**options, name: code}} if name not in ("env_id", "base") else {}
    parts = {"risk": {"hard_brake": asked}, "compare": sides, "compare sums": {"hard_brake/A": asked}}[command]
    for part, question in parts.items():
        Path("begun", part).mkdir(parents=True)
        begin_journal(Path("begun", part), question, whole=whole).close()
    assert_refused(cli("resume", "begun"), "not made here, and its question runs code: 'evil:", "add --trust")
    assert not Path("was_here").exists()


@pytest.mark.slow
@pytest.mark.parametrize("sums", [rare_envs.risk, compare_risks])
def test_a_sum_of_ones_own_goes_on_without_trust_and_that_of_others_with_it(
    sums: Any, received: Path, tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    egos = ("evil:make",) if sums is rare_envs.risk else ("idm", "evil:make")
    asked: dict[str, Any] = {"scenarios": ["hard_brake", "cut_in"], "method": "mc", "max_sim": 40, "seed": 0}

    def stop() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(DrivingProblem, "tile", 5)
    with monkeypatch.context() as patch, pytest.raises(RunInterrupted, match="rare-envs resume mine"):
        act_after(10, stop, patch)
        sums(*egos, **asked, out="mine")
    for name in ("theirs", "trusted"):
        shutil.copytree("mine", name)
    assert cli("resume", "mine").exit_code in (0, 3)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "new"))
    assert_refused(cli("resume", "theirs"), "not made here", "'evil:make'", "add --trust")
    assert cli("resume", "trusted", "--trust").exit_code in (0, 3)


def test_the_method_of_a_received_run_is_not_imported_for_a_plan(received: Path, cli: Cli) -> None:
    change_question(received, method="evil:Coasting")
    assert_refused(cli("estimate", received, "--plan"), "runs code: 'evil:Coasting'", "add --trust")
    result = json.loads((received / RESULT).read_text())
    result["method"]["name"] = "evil:Coasting"
    (received / RESULT).write_text(json.dumps(result))
    change_question(received, method="mc")
    assert cli("estimate", received, "--plan").exit_code == 0
    assert not Path("was_here").exists()


@pytest.mark.filterwarnings("ignore")  # of what has changed, and of odd values
@pytest.mark.parametrize("name", [each.name for each in fields(Question) if "str" in str(each.type)])
@pytest.mark.parametrize("value", ["evil:make", "lead=evil:make"])
def test_no_text_of_a_received_question_runs_code(name: str, value: str, received: Path) -> None:
    change_question(received, **{name: value})
    with contextlib.suppress(BadInput):
        find_failure(received, 0)
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


def test_an_ego_of_the_readers_own_is_asked_no_trust_but_the_rest_of_the_question_is(received: Path) -> None:
    change_question(received, ego="tcp://127.0.0.1:9")
    assert find_failure(received, 0, ego="idm").n_found > 0
    change_question(received, measure="evil:gap")
    with pytest.raises(BadInput, match=r"runs code: 'evil:gap' \("):
        find_failure(received, 0, ego="idm")


def test_a_run_that_went_on_with_an_address_of_ones_own_needs_no_trust(
    received: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agents, "load_ego", lambda *_, **__: "idm")
    question = Question(env_id=FOLLOWING, ego="tcp://127.0.0.1:9", base="us101-gap", method="mc", max_sim=100)
    Path("begun").mkdir()
    begin_journal(Path("begun"), question).close()
    with pytest.raises(BadInput, match="add --trust"):
        resume(Path("begun"))
    resume(Path("begun"), ego="tcp://127.0.0.1:8")
    assert open_run(load_study("begun"), trust=False).ego == "tcp://127.0.0.1:8"


def test_modules_of_ones_own_get_nothing_from_somebody_elses_folder(
    received: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, theirs = tmp_path / "own", tmp_path / "theirs"
    for folder, content in ((own / "kept", ""), (theirs / "kept", EVIL)):
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text(content)
    (own / "kept" / "egos.py").write_text(EVIL.replace('Path("was_here").touch()', "import helper"))
    (own / "helper.py").touch()
    (theirs / "helper.py").write_text(EVIL)
    monkeypatch.syspath_prepend(str(own))
    question = Question(env_id=FOLLOWING, ego="kept.egos:make", base="us101-gap", method="mc", max_sim=200, gamma=5.0)
    note_question(question)
    change_question(received, **asdict(question))
    monkeypatch.chdir(theirs)
    with pytest.raises(BadInput, match="runs code"):  # the package there would be imported first
        find_failure(received, 0)
    shutil.rmtree("kept")
    open_question(asdict(question), received, trust=False)
    agents.load_ego(question.ego)
    assert not Path("was_here").exists()


@pytest.mark.slow
def test_the_process_of_an_ego_finds_no_modules_in_the_working_directory(received: Path) -> None:
    for name in ("zmq.py", "agents.py"):
        Path(name).write_text(EVIL)
    ego: Any = agents.load_ego("process:imitation")
    assert ego.predict(np.zeros((1, 51), np.float32))[0].shape == (1, 2)
    assert not Path("was_here").exists()


def test_nothing_is_written_through_the_links_of_a_folder_nor_taken_from_its_matplotlibrc(
    received: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(matplotlib.rcParams, "text.usetex", True)
    outside = tmp_path / "outside"
    (outside / "figures").mkdir(parents=True)
    (outside / "precious").write_text("precious")
    (tmp_path / "half").mkdir()
    begin_journal(tmp_path / "half", replace(read_question(load_study(received).question), max_sim=100)).close()
    for name in RESULT_FILES:
        (tmp_path / "half" / name).symlink_to(outside / "precious")
    resume(tmp_path / "half")
    assert (outside / "precious").read_text() == "precious"
    assert not any((tmp_path / "half" / name).is_symlink() for name in (RESULT, FAILURES, EPISODES, STUDY, ANSWER))
    (received / "figures").symlink_to(outside / "figures")
    with pytest.raises(BadInput, match="figures' is a link, and nothing is written through one: remove it"):
        write_html_report(received, figures="svg")
    assert not any((outside / "figures").iterdir())


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
    Path("evil:make").touch()  # which need not be there when the ego is loaded
    for ego in ("idm", "ego.zip", "noisy:gail", "human:no-headway-rule", "process:imitation?timeout=3"):
        assert list_risks(Question(env_id=FOLLOWING, ego=ego)) == {}
    for ego in ("evil:make", f"{'a' * 300}:make"):
        assert list_risks(Question(env_id=FOLLOWING, ego=ego)) == {"ego": [ego]}


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


def test_files_of_each_driver_and_of_the_method_are_part_of_a_question(here: Path) -> None:
    files = ("a.zip", "a_vecnormalize.pkl", "b.onnx", "ways.py")
    for name in files:
        (here / name).write_bytes(b"content")
    drivers = "cutter=noisy:a.zip?latency=1,lead=b.onnx"
    question = Question(env_id="", drivers=drivers, method="ways:Method")
    assert sorted(Path(name).name for name in digest_files(question)) == list(files)
