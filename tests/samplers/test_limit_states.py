import numpy as np
import pytest

from samplers.limit_states import four_branches, half_space, parabola, plateau, shell, two_modes


@pytest.mark.parametrize(
    "reference",
    [
        half_space(3, 1.5),
        two_modes(distance=0.8),
        parabola(1.0),
        four_branches(k=1.8),
        plateau(beta=1.5),
        shell(5, 0.05),
    ],
    ids=lambda r: r.name,
)
def test_exact_probability_against_monte_carlo(rng, reference):
    """The same formulas with the failures near enough to be counted."""
    n = 400_000
    u = rng.standard_normal((n, reference.problem.dim))
    share = np.mean(reference.problem.evaluate(u) <= 0)
    assert share == pytest.approx(reference.p, abs=4 * np.sqrt(reference.p / n))
