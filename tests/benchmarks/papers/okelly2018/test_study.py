"""The study on a problem that costs nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.papers.okelly2018.scales import SEARCHES, STUDY_SCALES
from benchmarks.papers.okelly2018.study import HighwayStudy, measure_highway


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"ego": "radar"}, "an ego of lidar, vision"),
        ({"scale": "huge"}, "a scale of small, full"),
        ({"seed": -1}, "a seed of 0 or more"),
    ],
)
def test_bad_settings_are_refused(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        HighwayStudy(**arguments)


def test_all_stages_are_made_once(tiny: HighwayStudy, cheap: Any, out: Path) -> None:
    measured = measure_highway(tiny, out, cheap)
    scale = tiny.settings
    assert cheap.evaluated == scale.naive + len(SEARCHES) * scale.per_search
    assert [len(run.steps) for run in measured.searches.values()] == [2] * len(SEARCHES)
    again = measure_highway(tiny, out, cheap)
    assert cheap.evaluated == scale.naive + len(SEARCHES) * scale.per_search
    for name, run in measured.searches.items():
        assert [step.quantile for step in again.searches[name].steps] == [step.quantile for step in run.steps]


def test_a_run_that_is_stopped_in_a_search_goes_on(tiny: HighwayStudy, cheap: Any, out: Path, tmp_path: Path) -> None:
    whole = measure_highway(tiny, out, cheap)
    part = measure_highway(tiny, tmp_path / "other", cheap, limit=tiny.settings.naive + 400)
    first = next(iter(part.searches.values()))
    assert (len(first.steps), len(first.final)) == (1, 0)
    rest = measure_highway(tiny, tmp_path / "other", cheap)
    for name, run in whole.searches.items():
        assert all((a.f == b.f).all() for a, b in zip(rest.searches[name].final, run.final, strict=True))


def test_the_search_goes_to_small_outcomes(tiny: HighwayStudy, cheap: Any, out: Path) -> None:
    measured = measure_highway(tiny, out, cheap)
    naive = np.concatenate([each.f for each in measured.naive])
    for run in (run for name, run in measured.searches.items() if name.endswith("0.1")):
        found = np.concatenate([each.f for each in run.final])
        assert np.quantile(found, 0.1) < np.quantile(naive, 0.1) - 0.1


def test_our_own_method_is_run_once_for_each_threshold(
    tiny: HighwayStudy, cheap: Any, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STUDY_SCALES, ("lidar", "small"), replace(tiny.settings, own=400))
    measure_highway(tiny, out, cheap, limit=0)
    assert cheap.evaluated == 0
    own = measure_highway(tiny, out, cheap).own
    assert [each["gamma"] for each in own] == list(tiny.gammas)
    assert all(each["low"] <= each["p"] <= each["high"] and each["n_sim"] <= 400 for each in own)
    evaluated = cheap.evaluated
    assert measure_highway(tiny, out, cheap).own == own
    assert cheap.evaluated == evaluated
