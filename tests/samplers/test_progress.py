import math

import pytest

import samplers
from samplers.reference import half_space


@pytest.mark.parametrize("method", sorted(samplers.METHODS))
def test_listener_is_told_of_simulations_levels_and_p(method):
    seen = []
    problem = half_space().problem
    result = samplers.estimate(problem, method, seed=1, max_sim=6000, progress=seen.append)
    counts = [progress.n_sim for progress in seen]
    assert counts == sorted(counts)
    assert counts[-1] == result.n_sim
    assert seen[0].max_sim == 6000
    assert math.isnan(seen[0].p)
    assert seen[-1].level == result.trace[-1].gamma
    assert seen[-1].p == pytest.approx(result.p)
    assert result == samplers.estimate(problem, method, seed=1, max_sim=6000)


def test_listener_knows_the_replicate():
    seen = []
    samplers.estimate(half_space().problem, seed=1, replicates=3, progress=seen.append)
    assert sorted({progress.run for progress in seen}) == [0, 1, 2]


def test_bar_goes_to_standard_error(capsys):
    result = samplers.estimate(half_space().problem, seed=1, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert f"{result.n_sim:,} simulations" in err
    assert f"P[f <= 0] = {result.p:.2e}" in err


def test_silent_by_default(capsys):
    samplers.estimate(half_space().problem, seed=1)
    assert capsys.readouterr() == ("", "")
