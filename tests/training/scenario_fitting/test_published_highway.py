"""The assembled base distributions are those in the package."""

import json
from importlib import resources

import pytest

from training.scenario_fitting.base_files import format_base
from training.scenario_fitting.event_filters import EVENT_RECIPES
from training.scenario_fitting.published_highway import build_highway_base


def shipped(name):
    return json.loads((resources.files("rare_envs") / "data" / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize("scenario", EVENT_RECIPES)
def test_highway_files_are_what_the_script_writes(scenario):
    written = json.loads(format_base(scenario, build_highway_base(scenario)))
    assert written == shipped(f"{scenario}_highway.json")
    assert "NOT fitted" in written["provenance"]["kind"]
