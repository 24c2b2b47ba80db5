"""The draws of the estimate."""

import numpy as np
import pytest

from samplers.methods.surrogate import BASE, DOUBTED, SURROGATE, WIDE, EstimateDraws, PoolDraws


def drawn(parts, weights):
    n = len(parts)
    return PoolDraws(np.zeros((n, 2)), np.log(weights), np.array(parts), np.log(np.full(n, 0.5)))


def test_p_is_the_mean_over_all_draws_however_they_were_parted():
    made = EstimateDraws.begin(np.zeros(0))
    made = made.add(drawn([SURROGATE, BASE], [0.01, 1.0]), np.array([-1.0, 2.0]), np.zeros((2, 2)), 0.0, 1e-4)
    made = made.add(drawn([WIDE, DOUBTED], [0.02, 0.03]), np.array([-1.0, -1.0]), np.zeros((2, 2)), 0.0, 4e-4)
    assert made.draws.p == pytest.approx((0.01 + 0.02 + 0.03) / 4)
    np.testing.assert_array_equal(made.kinds, [[1, 1, 1, 1], [1, 0, 1, 1]])
    assert made.cov**2 == pytest.approx(made.draws.cov**2 + 4e-4)


def test_lineages_are_batches_and_wide_failures_of_design_and_draws():
    made = EstimateDraws.begin(np.zeros(3))
    made = made.add(drawn([WIDE, WIDE, DOUBTED], np.ones(3)), np.array([-1.0, 1.0, -1.0]), np.zeros((3, 2)), 0.0, 0.0)
    # three of the design with weight 1 and one of weight 1/2: (3.5)^2 / 3.25 effective ones
    assert made.count_lineages(5) == pytest.approx(5 + 3.5**2 / 3.25)
    assert EstimateDraws.begin(np.zeros(0)).count_lineages(0) == 1.0


@pytest.mark.parametrize(("failing", "warns"), [(4, True), (5, False)])
def test_a_surrogate_whose_draws_seldom_fail_says_so(failing, warns):
    outcomes = np.where(np.arange(10) < failing, -1.0, 1.0)
    made = EstimateDraws.begin(np.zeros(0)).add(drawn([SURROGATE] * 10, np.ones(10)), outcomes, np.zeros((10, 2)), 0, 0)
    assert bool(made.skill_warnings(0.5)) == warns
