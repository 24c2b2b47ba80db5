from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from rare_envs.study import Question, prepare
from rare_envs.study.run_folder import find_changed_results
from rare_envs.study.writing import (
    _describe_command,
    begin_study_file,
    describe_study,
    find_versions,
    finish_study_file,
    note_resumption,
)


def test_the_command_is_that_of_this_program_alone() -> None:
    assert _describe_command(["/x/bin/rare-envs", "estimate", "a b"]) == "rare-envs estimate 'a b'"
    assert _describe_command(["/x/rare_envs/__main__.py", "list"]) == "rare-envs list"
    assert _describe_command(["/x/pytest"]) == _describe_command([]) == ""


def test_the_fingerprint_is_that_of_the_files_of_the_ego(here: Path) -> None:
    question = Question(env_id="rare_envs/CarFollowing-v0", ego="egos_here:coasting")
    first = describe_study(prepare(question))["ego"]
    assert first["kind"] == "function" and [Path(name).name for name in first["files"]] == ["egos_here.py"]
    (here / "egos_here.py").write_text((here / "egos_here.py").read_text() + "\n# another")
    again = describe_study(prepare(question))["ego"]
    assert again["fingerprint"] != first["fingerprint"]
    (here / "sub").mkdir()
    assert describe_study(prepare(question))["ego"]["fingerprint"] == again["fingerprint"]


def test_a_run_that_ends_keeps_what_its_file_held_of_the_beginning(tmp_path: Path) -> None:
    study = prepare(Question(env_id="rare_envs/CarFollowing-v0"))
    (tmp_path / "study.json").write_text(json.dumps({"command": "rare-envs estimate", "finished": None}))
    finish_study_file(tmp_path, study, 2.5)
    found = json.loads((tmp_path / "study.json").read_text())
    assert found["command"] == "rare-envs estimate" and found["seconds"] == 2.5 and found["finished"]
    (tmp_path / "study.json").write_text("{")
    finish_study_file(tmp_path, study, 2.5)
    assert json.loads((tmp_path / "study.json").read_text())["seed"] == 0


def test_a_run_that_ends_notes_what_its_files_were(tmp_path: Path) -> None:
    study = prepare(Question(env_id="rare_envs/CarFollowing-v0"))
    begin_study_file(tmp_path, study)
    (tmp_path / "result.json").write_text("{}")
    finish_study_file(tmp_path, study, 2.5)
    about = json.loads((tmp_path / "study.json").read_text())
    assert find_changed_results(tmp_path, about) == []
    (tmp_path / "result.json").write_text("{ }")
    assert find_changed_results(tmp_path, about) == ["result.json"]


def test_the_file_of_another_run_is_written_anew(tmp_path: Path) -> None:
    asked = Question(env_id="rare_envs/CarFollowing-v0", seed=7, on_error="raise")
    begin_study_file(tmp_path, prepare(replace(asked, seed=8)))
    finish_study_file(tmp_path, prepare(asked), 2.5)
    assert json.loads((tmp_path / "study.json").read_text())["seed"] == 7
    before = json.loads((tmp_path / "study.json").read_text())
    (tmp_path / "study.json").write_text(json.dumps({**before, "command": "rare-envs estimate --seed 7"}))
    finish_study_file(tmp_path, prepare(replace(asked, on_error="bound")), 2.5)  # which may change
    assert json.loads((tmp_path / "study.json").read_text())["command"] == "rare-envs estimate --seed 7"


def test_a_resumption_is_noted_and_nothing_else_is_changed(tmp_path: Path) -> None:
    note_resumption(tmp_path, 5.0)  # no study.json
    assert not list(tmp_path.iterdir())
    (tmp_path / "study.json").write_text('{"begun": "then", "finished": null}')
    note_resumption(tmp_path, 600.5)
    about = json.loads((tmp_path / "study.json").read_text())
    assert about.pop("resumed") is not None
    assert about == {"begun": "then", "finished": None, "earlier_seconds": 600.5}
    (tmp_path / "study.json").write_text("[" * 100_000)
    note_resumption(tmp_path, 1.0)
    assert (tmp_path / "study.json").read_text() == "[" * 100_000


def test_the_versions_of_what_computes_are_noted() -> None:
    assert {"numba", "numpy", "scikit-learn", "torch"} <= set(find_versions())
