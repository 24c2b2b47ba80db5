from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rare_envs
from rare_envs.study.html_report.atlas import AtlasSource, build_atlas

MODE = {"crash": "rear_end", "p": 0.01, "interval": [0.005, 0.02], "of_failures": 0.75, "failure": 0}


@pytest.fixture
def source() -> AtlasSource:
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", horizon=3.0)
    failures = {"ego_speed": [20.0], "lead_speed": [5.0], "gap": [10.0], "f": [-1.0], "log_p0": [-9.0]}
    arrays = {name: np.array(values) for name, values in failures.items()}
    ordinary = problem.space.sample(200, np.random.default_rng(0))
    return AtlasSource(Path("runs/one"), problem, arrays, ordinary, ordinary[:5])


def test_an_entry_says_what_happened_and_how_to_see_it_again(source: AtlasSource) -> None:
    (entry,) = build_atlas(source, [MODE])
    facts = dict(entry.facts)
    assert entry.title == "Mode 1: the ego runs into a vehicle ahead" and entry.share.startswith("75 % of p: 1 %")
    assert facts["crash"].startswith("the ego into the lead after 0.8 s, at ") and facts["f"] == "-1"
    assert facts["closing speed"].endswith("m/s of it, at right angles to what touches")
    assert facts["replay"].startswith("rare-envs replay runs/one --failure 0")
    assert "standard deviations per parameter" in facts["nearest recorded"]
    assert [row[:2] for row in entry.parameters] == [
        ("ego_speed [m/s]", "20.00"),
        ("lead_speed [m/s]", "5.00"),
        ("gap [m]", "10.00"),
    ]
    assert [figure.name for figure in entry.figures] == ["mode1-views", "mode1-measure", "mode1-speeds"]
