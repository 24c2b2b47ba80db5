"""The assembled base distributions are those in the package."""

import json
from importlib import resources

import pytest

from training.scenario_fitting.base_files import format_base
from training.scenario_fitting.published_highway import build_highway_base
from training.scenario_fitting.shipped.bases import name_file


def shipped(name):
    return json.loads((resources.files("rare_envs") / "data" / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize("scenario", ["car_following", "rare_envs/CutIn-v0", "rare_envs/CutIn-v1"])
def test_highway_files_are_what_the_script_writes(scenario):
    written = json.loads(format_base(scenario, build_highway_base(scenario)))
    expected = shipped(name_file(scenario, "highway"))
    for name in ("checks", "checked_against"):  # what recordings say of it
        expected["provenance"].pop(name, None)
    assert written == expected
    assert "NOT fitted" in written["provenance"]["kind"]
