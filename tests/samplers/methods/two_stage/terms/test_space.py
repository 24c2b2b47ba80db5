import numpy as np
from scipy import stats

import samplers
from samplers.method import TermsOffer
from samplers.methods.two_stage.terms.space import TermSimulator, TransformSlopes


class Chained:
    """x0 half-normal, x1 = u1 exp(x0), x2 a gamma variable, the others N(0, 1); the last three are noise."""

    dim = 8

    def __init__(self, noise=True):
        self.noise = np.arange(8) >= 5 if noise else None
        self.calls = 0

    def sample(self, n, rng):
        return self.from_standard_normal(rng.standard_normal((n, 8)))

    def from_standard_normal(self, u):
        self.calls += len(u)
        x = u.copy()
        x[:, 0] = stats.halfnorm.ppf(stats.norm.cdf(u[:, 0]))
        x[:, 1] = u[:, 1] * np.exp(x[:, 0])
        x[:, 2] = stats.gamma.ppf(stats.norm.cdf(u[:, 2]), 3.0)
        return x

    def to_standard_normal(self, x):
        raise AssertionError("not needed")

    log_prob = to_standard_normal

    @property
    def base(self):
        return self


def test_gradients_are_pulled_back_through_the_transform(rng):
    """d g(T(u)) / du by differences of g o T itself, for g(x) = a.x + x0 x1."""
    inputs, a = Chained(), rng.standard_normal(8)

    def g(x):
        return x @ a + x[:, 0] * x[:, 1]

    u = rng.standard_normal((4, 8))
    x = inputs.from_standard_normal(u)
    by_x = np.tile(a, (4, 1))
    by_x[:, 0] += x[:, 1]
    by_x[:, 1] += x[:, 0]
    h = 1e-5 * np.eye(8)
    expected = [(g(inputs.from_standard_normal(p + h)) - g(inputs.from_standard_normal(p - h))) / 2e-5 for p in u]
    np.testing.assert_allclose(TransformSlopes(inputs).pull_back(u, by_x), expected, rtol=1e-5, atol=1e-6)


def test_coordinates_that_do_not_meet_are_moved_together(rng):
    """x0 and x1 both depend on u0; u1 may go with it no further than x1: two groups for five moved coordinates."""
    inputs = Chained()
    slopes, u = TransformSlopes(inputs), rng.standard_normal((10, 8))
    slopes.pull_back(u, np.ones((10, 8)))
    found = 3 * 2 * 5  # at three points, every moved coordinate up and down
    assert inputs.calls == found + 10 * 2 * 2


class Doubled:
    """x = 2 u, with its derivatives."""

    dim = 2

    def from_standard_normal(self, u):
        return 2.0 * u

    def sample(self, n, rng):
        return self.from_standard_normal(rng.standard_normal((n, 2)))

    def to_standard_normal(self, x):
        return x / 2.0

    def log_prob(self, x):
        return np.zeros(len(x))

    def pull_back(self, u, gradients):
        return 2.0 * gradients


class Beside(Chained):
    """Blocks: 2 u, and those of `Chained`."""

    dim = 10

    def __init__(self):
        super().__init__()
        self.noise = np.concatenate([[False, False], self.noise])
        self.blocks = (Doubled(), Chained())


def test_blocks_are_differentiated_each_for_itself(rng):
    inputs, u, gradients = Beside(), rng.standard_normal((4, 10)), rng.standard_normal((4, 10))
    found = TransformSlopes(inputs).pull_back(u, gradients)
    np.testing.assert_array_equal(found[:, :2], 2.0 * gradients[:, :2])
    np.testing.assert_allclose(found[:, 2:], TransformSlopes(Chained()).pull_back(u[:, 2:], gradients[:, 2:]))
    assert inputs.calls == 0


def test_standard_normal_space_needs_no_transform():
    gradients = np.ones((2, 3))
    assert TransformSlopes(samplers.FunctionProblem(lambda x: x[:, 0], 3)).pull_back(gradients, gradients) is gradients


def test_simulations_and_gradients_are_counted(half_spaces, answer):
    problem, _, normals = half_spaces(40, 1e-3, gradient_cost=2.5)
    simulator, u = TermSimulator(problem, TermsOffer(2.5)), np.zeros((3, 40))
    terms = answer(simulator.terms(u), problem)
    slopes = answer(simulator.gradients(u, terms.least, terms.ticks[:, 0]), problem)
    np.testing.assert_array_equal(slopes, -normals[terms.least])
    assert simulator.n_sim == 3 + 8  # 7.5, in whole simulations
    assert len(answer(simulator.gradients(u[:0], terms.least[:0], terms.least[:0]), problem)) == 0
