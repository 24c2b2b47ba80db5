"""Probabilities by a second way: other integrals, OpenTURNS, draws of the variables that are integrated out."""

import numpy as np
import pytest
from scipy import integrate, special, stats

from samplers.benchmark import public_references as references


def test_rp111_by_the_density_of_a_product() -> None:
    """P[abs(x y) > c] = 2 / pi times the integral of K_0 beyond c: 8.035e-7, where otbenchmark states 7.65e-7."""
    other = 2 / np.pi * integrate.quad(special.k0, 12.5, np.inf, epsabs=0, epsrel=1e-10)[0]
    assert references.rp111()[0] == pytest.approx(other, rel=1e-8)
    assert other == pytest.approx(8.035086e-7, rel=1e-6)


def test_rp75_by_the_density_of_a_product() -> None:
    other = integrate.quad(special.k0, 3.0, np.inf, epsabs=0, epsrel=1e-10)[0] / np.pi
    assert references.rp75()[0] == pytest.approx(other, rel=1e-8)


def test_rp63_and_rp22_by_the_same_integral_written_otherwise() -> None:
    q = np.random.default_rng(0).chisquare(99, 1_000_000)
    values = special.ndtr(4.5 - 0.1 * q)
    assert references.rp63()[0] == pytest.approx(values.mean(), abs=4 * values.std() / 1000)
    s = np.linspace(-10, 10, 20_001)
    total = (stats.norm.pdf(s) * special.ndtr(-2.5 - 0.2 * s**2)).sum() * (s[1] - s[0])
    assert references.rp22()[0] == pytest.approx(total, rel=1e-9)


def test_sums_and_products_by_openturns() -> None:
    openturns = pytest.importorskip("openturns")
    product = openturns.Normal(78_064, 11_710) * openturns.Normal(0.0104, 0.00156)
    assert references.rp28()[0] == pytest.approx(product.computeCDF(146.14), rel=1e-5)
    laws = [
        openturns.ParametrizedDistribution(openturns.LogNormalMuSigma(mean, sd, 0.0))
        for mean, sd in references.RP8_MARGINALS
    ]
    difference = laws[0] + 2 * laws[1] + 2 * laws[2] + laws[3] - 5 * laws[4] - 5 * laws[5]
    assert references.rp8()[0] == pytest.approx(difference.computeCDF(0.0), rel=1e-5)


@pytest.mark.parametrize(
    ("known", "conditional", "dim"),
    [(references.rp38, references.rp38_conditional, 6), (references.rp91, references.rp91_conditional, 4)],
)
def test_means_of_conditional_probabilities_by_plain_draws(known, conditional, dim) -> None:
    values = conditional(np.random.default_rng(3).standard_normal((400_000, dim)))
    error = values.std() / np.sqrt(len(values))
    p, stated = known()
    assert p == pytest.approx(values.mean(), abs=4 * error)
    assert stated < 0.1 * error


def test_rp14_with_draws_of_all_but_the_uniform_variable() -> None:
    u = np.random.default_rng(4).standard_normal((1_000_000, 4))
    x3 = references.gumbel(u[:, 1], 1500, 350)
    stress = np.sqrt(x3**2 * (400 + 0.1 * u[:, 2]) ** 2 / 16 + (250_000 + 35_000 * u[:, 3]) ** 2)
    values = np.clip((32 / (np.pi * (39 + 0.1 * u[:, 0]) ** 3) * stress - 70) / 10, 0.0, 1.0)
    assert references.rp14()[0] == pytest.approx(values.mean(), abs=4 * values.std() / 1000)


def test_marginals_have_their_means_and_standard_deviations() -> None:
    u = np.random.default_rng(0).standard_normal(1_000_000)
    for x in (references.lognormal(u, 1200, 480), references.gumbel(u, 1200, 480)):
        assert (x.mean(), x.std()) == pytest.approx((1200, 480), rel=0.01)
