"""Robustness of formulas by hand, and formulas that are refused."""

import numpy as np
import pytest

from rare_envs.measures import (
    Trace,
    TraceMeasure,
    stl,
    ttc,
    with_collision,
)
from tests.rare_envs.measures.moments import CLOSE, HIT, f, problem


def test_robustness_by_hand() -> None:
    pytest.importorskip("rtamt", reason="rtamt runs on Python 3.11 or older")
    assert f(stl("always (gap > 2)"), *CLOSE) == pytest.approx(-1.5, abs=1e-3)
    assert f(stl("always[0:5] (gap > 2)"), *CLOSE) == pytest.approx(48.5, abs=1e-3)  # 50.5 m at 5 s
    assert f(stl("eventually[2:3] (ttc < 7.5)"), *CLOSE) == pytest.approx(7.5 - 7.05, abs=1e-3)
    assert f(stl("always (speed_1 > 3 and x_0 < 150)"), *CLOSE) == pytest.approx(-50.0, abs=1e-3)
    assert f(stl("(gap > 20) until (speed > 19)"), *CLOSE) == pytest.approx(1.0)
    assert f(stl("always ((ttc < 3) implies (acceleration < -1))"), *CLOSE) == pytest.approx(-1.0, abs=1e-3)
    assert f(stl("always (gap > 2)"), *HIT) < -1.5  # the moment of the collision is part of it
    assert f(with_collision(stl("always (speed > 0)"), -5.0), *HIT) == -5.0


def test_robustness_is_what_the_signals_say() -> None:
    """ "always" is the least over time, "eventually" the greatest, bounds are in seconds."""
    pytest.importorskip("rtamt", reason="rtamt runs on Python 3.11 or older")
    kept: list[Trace] = []
    recorder = TraceMeasure(lambda trace: kept.append(trace) or trace.of(ttc).amin(0), collision=None)
    x = problem("ttc").base.sample(20, np.random.default_rng(3))
    problem(recorder).evaluate(x)
    gap, time = kept[-1].lead.gap.double().numpy(), kept[-1].of(ttc).double().numpy()
    both = problem(stl("always (gap > 2 and ttc > 3)")).evaluate(x)
    np.testing.assert_allclose(both, np.minimum(gap - 2.0, time - 3.0).min(0), rtol=1e-5)
    late = problem(stl("eventually[1:2.5] (always[0:0.5] (gap > 10))")).evaluate(x)
    windows = np.stack([gap[k : k + 6].min(0) - 10.0 for k in range(10, 26)])
    np.testing.assert_allclose(late, windows.max(0), rtol=1e-5)


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("always (gap >", ["does not parse"]),
        ("always (gpa > 2)", ["'gpa'", "did you mean 'gap'", "ttc"]),
        ("always (gap > 2) always (gap > 3)", ["one formula"]),
        ("", ["does not parse"]),
        (3, ["Expected a formula"]),
    ],
)
def test_bad_formulas_are_refused_before_anything_is_driven(formula: str, words: list[str]) -> None:
    pytest.importorskip("rtamt", reason="rtamt runs on Python 3.11 or older")
    with pytest.raises(ValueError) as error:
        stl(formula)
    assert all(word in str(error.value) for word in words)


def test_formulas_that_do_not_fit_the_world_are_refused() -> None:
    pytest.importorskip("rtamt", reason="rtamt runs on Python 3.11 or older")
    with pytest.raises(ValueError, match="vehicles are 0 to 1"):
        problem(stl("always (speed_2 > 1)"))
    with pytest.raises(ValueError, match="multiple of the sampling period"):
        problem(stl("always[0:0.05] (gap > 1)"))
