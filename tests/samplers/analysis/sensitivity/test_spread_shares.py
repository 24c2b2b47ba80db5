"""Shares of the spread over refits of which only two parameters vary."""

from dataclasses import replace

import pytest

from tests.samplers.analysis.sensitivity.parametric_normal import BASE, BETA, HAZARD, ParametricNormal, fitted, run


@pytest.fixture(scope="module")
def result():
    return run(max_sim=6000)


def test_shares_of_the_spread_add_up_and_name_what_varies():
    """Var of g_i delta_i: (0.8 h 0.3)^2 by the mean and (0.1 x 0.36 beta h)^2 by the sd."""
    found = run(fitted(200), max_sim=6000).sensitivity(["speed", "gap", "offset"])
    shares = {each.name: each.share for each in found.parameters}
    assert sum(shares.values()) == pytest.approx(1.0)
    one, two = (0.8 * HAZARD * 0.3) ** 2, (0.1 * 0.36 * BETA * HAZARD) ** 2
    assert shares["mean of speed"] == pytest.approx(one / (one + two), abs=0.08)
    assert sum(found.shares.values()) == pytest.approx(1.0)
    assert next(iter(found.shares)) == "speed"
    assert found.parameters[0].name == "mean of speed"
    assert found.correlation > 0.97
    assert found.first_order_spread == pytest.approx(found.spread, rel=0.15)
    assert "more recordings of speed would narrow the interval most" in str(found)


def test_nothing_is_recommended_where_first_order_is_poor():
    found = replace(run(fitted()).sensitivity(["speed", "gap", "offset"]), correlation=0.6)
    assert str(found).splitlines()[-1] == "first order describes the refits poorly: these shares are rough"


def test_shares_do_not_depend_on_the_units_of_parameters():
    base = fitted()
    scaled = fitted()
    scaled.parameters = lambda names=(), like=None: [
        each._replace(change=7 * each.change) for each in ParametricNormal.parameters(scaled, names)
    ]
    one, two = ({e.name: e for e in run(each).sensitivity().parameters} for each in (base, scaled))
    for name in one:
        assert one[name].share == pytest.approx(two[name].share, abs=1e-5)
        assert two[name].d_log_p == pytest.approx(7 * one[name].d_log_p, rel=1e-3, abs=1e-5)


def test_without_comparable_refits_there_are_no_shares(result):
    assert result.sensitivity().shares == {}
    assert "no refits" in str(result.sensitivity())
    base = fitted(15)
    for refit in base.refits[:8]:
        refit.parameters = lambda names=(), like=None: []
    found = run(base).sensitivity()
    assert (found.shares, found.n_refits) == ({}, (7, 15))
    assert found.reason == "only 7 of 15 refits have the parameters of the base, so that no share is known"
    same = fitted(12)
    same.refits = (ParametricNormal(BASE.mean, BASE.sd),) * 12
    assert "does not differ" in run(same).sensitivity().reason
