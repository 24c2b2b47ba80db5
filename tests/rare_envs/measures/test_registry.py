"""Measures by name, by module and by formula; what is refused, and when."""

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

import rare_envs
from rare_envs.measures import Measure, Moment, TraceMeasure, minimum, stl, ttc, weighted
from rare_envs.measures.registry import find_measure
from tests.rare_envs.measures.moments import AWAY, CLOSE, FOLLOWING, problem


def test_measures_by_what_a_user_types(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "measures_here.py").write_text(
        "from rare_envs.measures import Measure, ttc\n"
        "def gap(moment):\n    return moment.lead.gap\n"
        "mine = Measure(ttc, collision=-7.0)\n"
        "number = 3\n"
    )
    monkeypatch.chdir(tmp_path)
    x = rare_envs.DrivingProblem(FOLLOWING).base.sample(20, np.random.default_rng(0))

    def of(measure: object) -> np.ndarray:
        return problem(measure, horizon=1.0).evaluate(x)

    np.testing.assert_array_equal(of("measures_here:gap"), of(lambda moment: moment.lead.gap))
    np.testing.assert_array_equal(of("measures_here:mine"), of(Measure(ttc, collision=-7.0)))
    with pytest.raises(ValueError, match="Unknown measure 3"):
        of("measures_here:number")


def test_a_formula_by_what_a_user_types() -> None:
    pytest.importorskip("rtamt", reason="rtamt runs on Python 3.11 or older")
    x = rare_envs.DrivingProblem(FOLLOWING).base.sample(5, np.random.default_rng(0))
    found = [
        rare_envs.DrivingProblem(FOLLOWING, measure=measure, horizon=1.0).evaluate(x)
        for measure in ("stl: always (gap > 2)", stl("always (gap > 2)"))
    ]
    np.testing.assert_array_equal(*found)
    with pytest.raises(ValueError, match="does not parse"):
        rare_envs.DrivingProblem(FOLLOWING, measure="stl:always (gap >")


def test_unknown_measures_are_refused() -> None:
    for name, near in (("dracc", "drac"), ("rss_margins", "rss_margin"), ("ttc2d", "ttc_2d")):
        with pytest.raises(ValueError, match=near) as error:
            problem(name)
        assert "docs/measures.md" in str(error.value)
    for nonsense in (None, 3, ["ttc"], Measure):
        with pytest.raises(ValueError, match="Unknown measure"):
            find_measure(nonsense)
    for build in (minimum, weighted, lambda: weighted("ttc"), lambda: weighted(("ttc", -1.0)), lambda: minimum("tcc")):
        with pytest.raises(ValueError, match=r"Expected|Unknown"):
            build()


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda moment: moment.state.speed, "shape"),
        (lambda moment: moment.lead.gap.mean(), "shape"),
        (lambda moment: 1.0, "got 1.0"),
        (lambda moment: moment.lead.gap < 1.0, "small where it is dangerous, got .*bool"),
        (lambda moment: moment.lead.gap * math.nan, "finite"),
        (lambda moment: moment.lead.headway, "headway"),
        (TraceMeasure(lambda trace: trace.lead.gap), "shape"),
        (TraceMeasure(lambda trace: 3.0, collision=None), "shape"),
    ],
)
def test_broken_measures_are_refused_at_the_door(function: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        problem(function)
    with pytest.raises(ValueError, match=words):
        gym.make(FOLLOWING, measure=function)


def test_a_measure_that_breaks_later_names_the_scenario() -> None:
    def sometimes(moment: Moment) -> Tensor:
        return torch.where(moment.lead.gap > 90.0, math.nan, moment.lead.gap)

    with pytest.raises(ValueError, match=r"NaN.*ego_speed"):
        problem(sometimes).evaluate(np.array([AWAY, CLOSE]))
