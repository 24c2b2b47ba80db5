from __future__ import annotations

import json
from pathlib import Path

from rare_envs.study import Question, prepare
from rare_envs.study.writing import (
    _describe_command,
    describe_study,
    finish_study_file,
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
