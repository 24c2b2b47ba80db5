import numpy as np
import pytest

from samplers.limit_states import (
    four_branches,
    half_space,
    parabola,
    plateau,
    references,
    shell,
    two_modes,
    unannounced_region,
)


@pytest.mark.parametrize(
    "reference",
    [
        half_space(3, beta=1.5),
        two_modes(distance=0.8),
        parabola(beta=1.0),
        four_branches(k=1.8),
        plateau(beta=1.5),
        shell(5, p=0.05),
        unannounced_region(1.5, 1.2),
    ],
    ids=lambda r: r.name,
)
def test_exact_probability_against_monte_carlo(rng, reference):
    """The same formulas with the failures near enough to be counted."""
    n = 400_000
    u = rng.standard_normal((n, reference.problem.dim))
    share = np.mean(reference.problem.evaluate(u) <= 0)
    assert share == pytest.approx(reference.p, abs=4 * np.sqrt(reference.p / n))


def test_unannounced_region_is_the_likelier_one_and_f_rises_towards_it():
    reference = unannounced_region()
    assert reference.p == pytest.approx(9.99e-4, rel=1e-3)
    u = np.array([[-3.2, 0.0], [-3.0, 0.0], [0.0, 0.0], [3.9, 0.0], [4.1, 0.0]])
    f = reference.problem.evaluate(u)
    np.testing.assert_array_equal(f <= 0, [True, False, False, False, True])
    assert f[1] > f[2] > f[3] > 0


def test_references_are_rare_and_named_apart():
    names = [reference.name for reference in references()]
    assert len(set(names)) == len(names)
    assert "unannounced" in names
    assert all(1e-5 < reference.p < 2e-3 for reference in references())
