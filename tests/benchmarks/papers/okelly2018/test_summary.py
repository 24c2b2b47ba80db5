"""Figures of the study from runs whose answers are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.papers.okelly2018 import summary
from benchmarks.papers.okelly2018.behaviour import RunBehaviour
from benchmarks.papers.okelly2018.study import HighwayStudy, measure_highway
from benchmarks.papers.okelly2018.summary import summarise_highway


@pytest.fixture(autouse=True)
def still(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the drives of the findings away: they are tested with `behaviour`."""
    monkeypatch.setattr(summary, "measure_behaviour", lambda problem, x: RunBehaviour(*np.ones((4, len(x)))))


def test_starts_alone_are_weighted_right(tiny: HighwayStudy, cheap: Any, out: Path) -> None:
    found = summarise_highway(tiny, cheap, measure_highway(tiny, out, cheap))
    search = found["searches"]["starts alone, rho 0.1"]
    assert 0.3 < search["mean_ratio"] < 3.0
    assert abs(search["comparisons"][-1]["errors_off"]) < 4
    assert search["search"] == 600
    assert found["rollouts"] == 1000 + 4 * 900
    assert [each["events"] for each in found["naive"]] == sorted(each["events"] for each in found["naive"])


def test_what_fails_is_seen_in_the_starts(tiny: HighwayStudy, cheap: Any, out: Path) -> None:
    found = {
        each.claim: each for each in summarise_highway(tiny, cheap, measure_highway(tiny, out, cheap))["findings"][:4]
    }
    assert found["vehicles box in the ego: neighbours are nearer"].verdict == "holds"


def test_what_is_not_run_is_left_out(tiny: HighwayStudy, cheap: Any, out: Path) -> None:
    found = summarise_highway(tiny, cheap, measure_highway(tiny, out, cheap, limit=500))
    assert len(found["naive"]) == 4
    assert all(not each["estimates"] for each in found["searches"].values())
    none = summarise_highway(tiny, cheap, measure_highway(tiny, out / "other", cheap, limit=0))
    assert (none["naive"], none["findings"], none["rollouts"]) == ([], [], 0)
