"""Pools inverted in logarithms agree with plain numbers where both do, and go on where these end."""

import numpy as np
from scipy import stats

from rare_envs.distributions import ClosingSpeed, CoordinateMixture, Coordinates
from rare_envs.distributions.pooled_mixture import PooledMixture, pool_mixtures
from rare_envs.distributions.quantiles.pool_by_logarithms import find_quantiles_by_logarithms

BOX = {"low": [0.0, 1.0, 0.0], "high": [45.0, 150.0, 45.0], "names": ("speed", "gap", "lead_speed")}
CLOSING = CoordinateMixture(
    Coordinates(**BOX, kinds=("plain", "log", ClosingSpeed("speed", "gap"))),
    [0.6, 0.4],
    [[15.0, 3.0, 0.1], [20.0, 3.4, -0.2]],
    [np.diag([4.0, 0.2, 0.1]), np.diag([9.0, 0.1, 0.2])],
)
PLAIN = CoordinateMixture(
    Coordinates(**BOX, kinds=("plain",) * 3), [1.0], [[14.0, 30.0, 14.0]], [np.diag([9.0, 100.0, 9.0])]
)
POOL = pool_mixtures([CLOSING, CLOSING, PLAIN])
assert isinstance(POOL, PooledMixture)


def test_both_ways_find_the_same_quantiles_of_every_column() -> None:
    """Out to 8 standard deviations; the two differ by the rounding of coordinates, and of logarithms near the ends."""
    u = np.random.default_rng(0).normal(0.0, 2.0, (400, 3)).clip(-8.0, 8.0)
    x, parts = POOL.from_standard_normal(u), POOL._start()
    for j in range(3):
        terms = [part.term(j, x) for part in parts]
        found = find_quantiles_by_logarithms(j, x, u[:, j], terms)
        np.testing.assert_allclose(found, x[:, j], rtol=1e-9, atol=1e-13)
        parts = [part.observe(j, x, term.conditional) for part, term in zip(parts, terms, strict=True)]


def test_a_row_beyond_plain_numbers_is_found_too() -> None:
    """35 standard deviations out, where the tail is half of that of the wide component."""
    wide = CoordinateMixture(Coordinates([-200.0], [200.0], ("plain",), ("x",)), [1.0], [[0.0]], [[[4.0]]])
    narrow = CoordinateMixture(Coordinates([-200.0], [200.0], ("plain",), ("x",)), [1.0], [[0.0]], [[[1.0]]])
    pool = PooledMixture((wide, narrow), [0.5, 0.5])
    x = pool.from_standard_normal([[35.0], [-35.0], [1.0]])[:, 0]
    np.testing.assert_allclose(stats.norm.logsf(x[0], scale=2.0) + np.log(0.5), stats.norm.logsf(35.0), rtol=1e-9)
    np.testing.assert_allclose(x[1], -x[0], rtol=1e-12)
    assert pool.from_standard_normal([[1.0]])[0, 0] == x[2]
