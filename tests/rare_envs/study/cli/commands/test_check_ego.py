"""The command `check-ego`: exit codes, and what it passes on."""

from __future__ import annotations

import json

from tests.rare_envs.study.refusals import FOLLOWING, Cli


def test_a_remote_file_is_refused(cli: Cli) -> None:
    refused = cli("check-ego", "https://example.org/ego.zip", FOLLOWING)
    assert refused.exit_code == 2
    assert "remote place" in refused.stdout


def test_an_unknown_environment_is_one_line(cli: Cli) -> None:
    refused = cli("check-ego", "idm", "rare_envs/CutIn-v9")
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert "rare_envs/CutIn-v0" in refused.stderr


def test_it_is_tried_in_the_traffic_that_is_asked_for(cli: Cli) -> None:
    findings = json.loads(cli("check-ego", "idm", FOLLOWING, "--base", "nowhere", "--json").stdout)["findings"]
    assert findings[-1]["status"] == "fail"
    assert "nowhere" in findings[-1]["found"]
