"""Bases of OpenTURNS."""

import pickle

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.distributions import OpenTurnsDistribution

openturns = pytest.importorskip("openturns")


def correlated(rho=0.5):
    matrix = openturns.CorrelationMatrix(2)
    matrix[0, 1] = rho
    return matrix


BASES = {
    "normal": lambda: openturns.Normal([1.0, 2.0], [1.0, 2.0], correlated()),
    "nataf": lambda: openturns.JointDistribution(
        [openturns.LogNormal(0, 0.5), openturns.Gumbel(1, 2)], openturns.NormalCopula(correlated())
    ),
    "rosenblatt": lambda: openturns.JointDistribution(
        [openturns.Exponential(1.0), openturns.Uniform(0, 1)], openturns.ClaytonCopula(2.0)
    ),
    "copula": lambda: openturns.GumbelCopula(2.0),
    "normal copula": lambda: openturns.NormalCopula(correlated()),
    "independent": lambda: openturns.JointDistribution([openturns.WeibullMin(1, 2), openturns.Student(4.0)]),
    "mixture": lambda: openturns.Mixture([openturns.Normal(2), openturns.Normal([3.0, 3.0], [1.0, 1.0])]),
    "kernel": lambda: openturns.KernelSmoothing().build(openturns.Sample([[0.0], [1.0], [3.0], [3.5], [4.0]])),
    "student": lambda: openturns.Student(4.0),
    "interface": lambda: openturns.Distribution(openturns.Gamma(2.0, 1.0)),
}


@pytest.fixture(params=BASES, scope="module")
def base(request):
    return OpenTurnsDistribution(BASES[request.param]())


@pytest.mark.parametrize("base", [name for name in BASES if name != "student"], indirect=True)
def test_it_is_the_transformation_of_openturns(base):
    """But for Student's distribution, which OpenTURNS maps to itself and not to the normal: see the next test."""
    u = np.random.default_rng(0).standard_normal((50, base.dim))
    x = base.from_standard_normal(u)
    forward = base.distribution.getIsoProbabilisticTransformation()
    for row, point in zip(u, x, strict=True):  # point by point, as it is called there
        np.testing.assert_allclose(np.array(forward(point)), row, rtol=0, atol=1e-8)
    np.testing.assert_allclose(base.to_standard_normal(x), u, rtol=0, atol=1e-8)


def test_points_far_out_are_finite(base):
    for u in (-12.0, 12.0):
        assert np.isfinite(base.from_standard_normal(np.full((1, base.dim), u))).all()


def test_it_travels_to_workers(base):
    copy = pickle.loads(pickle.dumps(base))
    u = np.full((2, base.dim), 0.7)
    np.testing.assert_allclose(copy.from_standard_normal(u), base.from_standard_normal(u))


def test_what_has_no_map_is_refused():
    with pytest.raises(ValueError, match="Poisson of OpenTURNS, which is not"):
        OpenTurnsDistribution(openturns.Poisson(3.0))
    with pytest.raises(ValueError, match=r"leads to Student, not to N\(0, I\)"):
        OpenTurnsDistribution(openturns.Student(4.0, [0.0, 0.0], [1.0, 1.0], correlated()))


def test_a_map_that_has_not_the_density_is_refused():
    """OpenTURNS 1.27 maps this distribution wrongly: x1 + x2 is Beta(3, 3), and p would be 1.7e-3 where it is 1e-3."""
    with pytest.raises(
        ValueError, match=r"transformation of this Dirichlet does not have its density \(off by \d+ %\)"
    ):
        OpenTurnsDistribution(openturns.Dirichlet([1.0, 2.0, 3.0]))


def test_p_with_correlated_normals_is_exact():
    """X ~ N(0, R), correlation 0.5: P[x1 + x2 >= 6] = Phi(-6 / sqrt(3)) = 2.7e-4."""
    base = openturns.JointDistribution([openturns.Normal(), openturns.Normal()], openturns.NormalCopula(correlated()))
    problem = samplers.FunctionProblem(lambda x: 6.0 - x.sum(axis=1), base=base)
    result = samplers.estimate(problem, "two-stage", seed=0, max_sim=3000)
    assert problem.dim == 2
    assert abs(result.p / stats.norm.cdf(-6 / 3**0.5) - 1) < 4 * result.cov < 0.5


def test_p_under_a_clayton_copula_is_its_lower_tail():
    """C(v, v) = (2 v^-2 - 1)^(-1/2) for theta = 2: at v = 1e-3 it is 7.07e-4."""
    problem = samplers.FunctionProblem(lambda x: np.log(x.max(axis=1) / 1e-3), base=openturns.ClaytonCopula(2.0))
    result = samplers.estimate(problem, "two-stage", seed=0, max_sim=3000)
    exact = (2 * 1e-3**-2.0 - 1) ** -0.5
    assert abs(result.p / exact - 1) < 4 * result.cov < 0.5


def test_a_description_names_the_columns():
    pair = openturns.JointDistribution([openturns.Normal(), openturns.Gumbel()])
    assert OpenTurnsDistribution(pair).column_names == ()
    pair.setDescription(["strength", "load"])
    problem = samplers.FunctionProblem(lambda x: x[:, 0], base=pair)
    assert problem.column_names == ("strength", "load")
