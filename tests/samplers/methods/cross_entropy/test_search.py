"""Iterates of the cross-entropy search: what one round says, and which proposal is sampled from."""

import numpy as np
import pytest

from samplers.importance import Round
from samplers.methods.cross_entropy import best_iterate, make_iterate


def test_an_iterate_holds_quantile_level_and_estimate():
    """Ten draws, f = 0, 1, ..., 9: the 0.3-quantile is the third outcome; weights 2 and 4 make p = 6 / 10."""
    drawn = Round(None, None, np.empty((10, 1)), np.arange(10.0)[::-1].copy())
    iterate = make_iterate(drawn, None, 1.0, 0.3, np.log([2.0, 4.0]))
    assert (iterate.quantile, iterate.level) == (2.0, 1.0)
    assert iterate.record.estimate == pytest.approx(0.6)
    assert (iterate.record.p, iterate.record.n_sim) == (0.2, 10)


def test_choice_of_the_iterate():
    """Lowest rho-quantile, or the smallest c.o.v. among those that reached gamma = 0."""
    iterates = []
    for shift, log_weights in ((1.0, [0.0, 0.0]), (-1.0, [0.0, 0.0]), (-3.0, [0.0, 2.0])):
        drawn = Round(None, None, np.empty((4, 1)), shift + np.array([0.0, 0.0, 1.0, 1.0]))
        iterates.append(make_iterate(drawn, None, max(shift, 0.0), 0.5, np.array(log_weights)))
    assert best_iterate(iterates, "quantile").quantile == -3.0
    assert best_iterate(iterates, "cov").quantile == -1.0
    assert best_iterate([], "cov") is None
