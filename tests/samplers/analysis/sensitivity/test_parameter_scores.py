"""Derivatives of log p in closed form on half-spaces: d log p / d mu = phi(beta) / Phi(-beta) along alpha."""

import numpy as np
import pytest

import samplers
from samplers.analysis.sensitivity import parameter_scores, refit_displacements
from tests.samplers.analysis.sensitivity.parametric_normal import ALPHA, BASE, BETA, HAZARD, fitted, run


@pytest.fixture(scope="module")
def result():
    return run(max_sim=6000)


@pytest.mark.parametrize("method", ["two-stage", "mc", "is", "ce", "adss"])
def test_derivatives_are_those_of_the_half_space(method):
    """By a mean, per standard deviation: alpha_j h with h = phi / Phi(-); by a sd, per 10 %: 0.1 alpha_j^2 beta h."""
    found = run(method=method, max_sim=60_000 if method == "mc" else 6000).sensitivity()
    expected = dict(
        zip(
            [each.name for each in BASE.parameters()],
            [*(ALPHA * HAZARD), *(0.1 * ALPHA**2 * BETA * HAZARD)],
            strict=True,
        )
    )
    for each in found.parameters:
        assert each.d_log_p == pytest.approx(expected[each.name], abs=4 * each.error + 1e-6)
        assert 0 < each.error < 0.5


def test_standard_errors_are_those_of_repetitions():
    """The spread of 30 runs over the stated error: 1 within the error of 30 draws."""
    found = [
        {each.name: each for each in run(method="is", seed=seed, max_sim=1500).sensitivity().parameters}
        for seed in range(30)
    ]
    for j, name in enumerate(("mean of x1", "mean of x3")):
        z = np.array([(each[name].d_log_p - (ALPHA * HAZARD)[2 * j]) / each[name].error for each in found])
        assert abs(z.mean()) < 4 / np.sqrt(30)
        assert 0.6 < z.std() < 1.5


def test_derivatives_agree_with_finite_differences_of_common_draws(result):
    """The same failing points under bases to both sides: no error of sampling between the two."""
    parameters = BASE.parameters()
    values = np.array([each.value for each in parameters])
    derivatives = {each.name: each.d_log_p for each in result.sensitivity().parameters}
    for i, each in enumerate(parameters):
        step = np.zeros(len(values))
        step[i] = 1e-3 * each.change
        up, down = (result.reweight(BASE.with_parameters(values + sign * step)).p for sign in (1, -1))
        assert derivatives[each.name] == pytest.approx((np.log(up) - np.log(down)) / 2e-3, abs=1e-3)


def test_refits_follow_the_numbering_of_their_base_and_others_are_left_out():
    base = fitted(3)
    displacements, used = refit_displacements(base, [base.refits[0], samplers.StandardNormal(3), base.refits[2]])
    assert used == [0, 2]
    assert displacements.shape == (2, 6)
    first = base.refits[0]
    assert displacements[0, 0] == pytest.approx((first.mean[0] - base.mean[0]) / base.sd[0])
    assert displacements[0, 4] == pytest.approx((first.sd[1] - base.sd[1]) / (0.1 * base.sd[1]))
    assert np.all(displacements[:, [1, 2, 3, 5]] == 0)


def test_the_score_has_mean_zero_under_the_base():
    """E[d log p0 / d theta] = 0, and its variance by a mean, per standard deviation, is 1."""
    x = BASE.sample(20_000, np.random.default_rng(0))
    scores = parameter_scores(BASE, x)
    assert np.abs(scores.mean(axis=0) / scores.std(axis=0)).max() < 4 / np.sqrt(len(x))
    assert scores[:, :3].std(axis=0) == pytest.approx(1.0, abs=0.03)
