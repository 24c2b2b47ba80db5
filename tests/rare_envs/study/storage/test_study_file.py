from __future__ import annotations

import json
from pathlib import Path

from rare_envs.study import Question, prepare
from rare_envs.study.writing import (
    _describe_command,
    finish_study_file,
)


def test_the_command_is_that_of_this_program_alone() -> None:
    assert _describe_command(["/x/bin/rare-envs", "estimate", "a b"]) == "rare-envs estimate 'a b'"
    assert _describe_command(["/x/rare_envs/__main__.py", "list"]) == "rare-envs list"
    assert _describe_command(["/x/pytest"]) == _describe_command([]) == ""


def test_a_run_that_ends_keeps_what_its_file_held_of_the_beginning(tmp_path: Path) -> None:
    study = prepare(Question(env_id="rare_envs/CarFollowing-v0"))
    (tmp_path / "study.json").write_text(json.dumps({"command": "rare-envs estimate", "finished": None}))
    finish_study_file(tmp_path, study, 2.5)
    found = json.loads((tmp_path / "study.json").read_text())
    assert found["command"] == "rare-envs estimate" and found["seconds"] == 2.5 and found["finished"]
    (tmp_path / "study.json").write_text("{")
    finish_study_file(tmp_path, study, 2.5)
    assert json.loads((tmp_path / "study.json").read_text())["seed"] == 0
