"""Lines that say how far a fit has come: every stage, and counts every few seconds."""

from __future__ import annotations

import numpy as np
import pytest

from rare_envs.distributions.space import Parameter
from training.scenario_fitting.coordinate_systems import CoordinateSystem
from training.scenario_fitting.event_filters import EventSet
from training.scenario_fitting.fit_progress import SECONDS_BETWEEN, FitProgress
from training.scenario_fitting.refits import refit


def test_counts_are_printed_every_few_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    now = 100.0
    progress = FitProgress(clock=lambda: now)
    count = progress.counter("cut_in")
    progress.say("cut_in: 40 events")
    for number in range(20):
        now += 0.3 * SECONDS_BETWEEN
        count(f"refit {number + 1} of 20")
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.splitlines() == [
        "cut_in: 40 events",
        *(f"cut_in: refit {number} of 20" for number in range(4, 21, 4)),
    ]


def test_each_refit_is_told() -> None:
    rng = np.random.default_rng(0)
    events = EventSet(rng.uniform(10.0, 20.0, (40, 1)), np.arange(40))
    told: list[str] = []
    refit(events, [CoordinateSystem("plain")], [Parameter("gap", "m", 0.0, 100.0, "")], n=3, report=told.append)
    assert told == [f"refit {number} of 3" for number in (1, 2, 3)]
