"""Pool: many draws from a known mixture, judged by the surrogate; the few that are simulated are chosen among them.

With N draws u_i from a mixture Q, w_i = phi(u_i) / Q(u_i), and a point i simulated with probability b_i in each of n
trials, the mean of 1[f(u_i) <= gamma] w_i / (N b_i) over the trials is an unbiased estimate of p whatever b is. With
b_i in proportion to w_i sqrt(P[fail | u_i]) its variance is least if the surrogate is right (compare Dubourg, Sudret
and Deheeger 2013, who take P[fail | u] itself).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.mixture_em import fit_proposal_mixture
from samplers.methods.surrogate.kriging import Kriging, Prediction
from samplers.methods.surrogate.settings import PoolSettings, ProposalSettings
from samplers.problem import FloatArray, StandardNormal
from samplers.proposals.gaussian import Gaussian
from samplers.proposals.log_sums import log_sum_exp
from samplers.proposals.mixture import Mixture
from samplers.proposals.shrinkage import fit_shrunk_gaussian
from samplers.statistics.weights import effective_sample_size, normalise_weights


class Pool(NamedTuple):
    """N draws of a mixture and what the surrogate says of them."""

    u: FloatArray
    """Shape (N, d)."""
    log_weights: FloatArray
    """log(phi / Q), shape (N,)."""
    prediction: Prediction

    @property
    def log_proposal(self) -> FloatArray:
        """log(w sqrt(P[fail])) but for a constant: which draws to simulate for the estimate, shape (N,)."""
        return self.log_weights + 0.5 * self.prediction.log_fail

    @property
    def log_doubt(self) -> FloatArray:
        """log(w sqrt(P[fail] P[safe])) but for a constant: which draws to learn from, shape (N,)."""
        return self.log_proposal + 0.5 * self.prediction.log_safe

    @property
    def log_doubted(self) -> FloatArray:
        """log(w sqrt(P[fail])) of the surrogate not believed, but for a constant, shape (N,)."""
        return self.log_weights + 0.5 * self.prediction.doubted.log_fail

    @property
    def log_open(self) -> FloatArray:
        """log(w sqrt(P[fail] P[safe])) of the surrogate not believed, but for a constant, shape (N,)."""
        return self.log_doubted + 0.5 * self.prediction.doubted.log_safe

    def forecast_cov(self, n: int) -> float:
        """Return the c.o.v. that n draws of the proposal would have if the surrogate's probabilities were true.

        With b ~ w sqrt(P), n cov^2 = (sum w sqrt(P) / sum w P)^2 - 1.
        """
        ratio = float(log_sum_exp(self.log_proposal)) - log_sum_exp(self.log_weights + self.prediction.log_fail)
        return float(np.sqrt(np.expm1(min(2 * ratio, 100.0)) / max(n, 1)))


def isotropic_normals(dim: int, scales: tuple[float, ...]) -> list[Gaussian]:
    """Return N(0, s^2 I) for the scales s."""
    return [Gaussian(np.zeros(dim), scale * np.eye(dim)) for scale in scales]


def first_mixture(dim: int, scales: tuple[float, ...]) -> Mixture:
    """Return the equal mixture of N(0, s^2 I), from which the first pool is drawn."""
    return Mixture(np.full(len(scales), 1 / len(scales)), isotropic_normals(dim, scales))


def draw_mixture_pool(kriging: Kriging, mixture: Mixture, n: int, rng: np.random.Generator) -> Pool:
    """Draw n points of a mixture."""
    u = mixture.sample(n, rng)
    return Pool(u, StandardNormal(u.shape[1]).log_prob(u) - mixture.log_prob(u), kriging.predict(u))


def fit_mixture(pool: Pool, scales: tuple[float, ...], settings: PoolSettings, rng: np.random.Generator) -> Mixture:
    """Return base, wide and fitted Gaussians, the last fitted to draws of the pool in proportion to the proposal."""
    chosen = rng.choice(len(pool.u), settings.fitted_points, p=normalise_weights(pool.log_proposal))
    points, dim = pool.u[chosen], pool.u.shape[1]
    equal = np.full(len(points), 1 / len(points))
    fitted = fit_proposal_mixture(fit_shrunk_gaussian, points, equal, settings.components, 3 * dim, rng)
    base, wide, share = settings.shares
    shares = [base, *np.full(len(scales) - 1, wide / (len(scales) - 1)), share]
    return Mixture(np.array(shares), [*isotropic_normals(dim, scales), fitted.widen(settings.widening)])


class PoolDraws(NamedTuple):
    """Draws from a pool."""

    u: FloatArray
    """Shape (n, d)."""
    log_weights: FloatArray
    """log(w / (N b)), shape (n,)."""
    part: NDArray[np.int64]
    """What each was drawn from: 0 surrogate, 1 base, 2 wide, 3 doubted, shape (n,)."""
    log_wide_weights: FloatArray
    """log(phi / wide), shape (n,): the weights as draws of the wide distribution."""


class PoolProposal(NamedTuple):
    """The probabilities with which draws of a pool are simulated: surrogate, base, wide and doubted parts."""

    pool: Pool
    shares: FloatArray
    """Of the parts, shape (4,)."""
    parts: FloatArray
    """Probabilities of each part, shape (4, N)."""
    log_wide_weights: FloatArray
    """log(phi / wide), shape (N,)."""

    @property
    def largest_weight(self) -> float:
        """Upper bound of the weights."""
        return float(np.exp(log_sum_exp(self.pool.log_weights))) / (len(self.pool.u) * float(self.shares[1]))

    @property
    def pool_variance(self) -> float:
        """Squared c.o.v. that the pool itself adds: 1 / its effective number of draws that may fail."""
        return 1 / effective_sample_size(self.pool.log_weights + self.pool.prediction.log_fail)

    def draw(self, n: int, rng: np.random.Generator) -> PoolDraws:
        """Draw n of the pool."""
        part = rng.choice(len(self.shares), n, p=self.shares)
        chosen = np.empty(n, dtype=np.int64)
        for k in range(len(self.shares)):
            chosen[part == k] = rng.choice(len(self.pool.u), int((part == k).sum()), p=self.parts[k])
        probability = self.shares @ self.parts[:, chosen]
        log_weights = self.pool.log_weights[chosen] - np.log(len(self.pool.u) * probability)
        return PoolDraws(self.pool.u[chosen], log_weights, part, self.log_wide_weights[chosen])


def build_pool_proposal(pool: Pool, scales: tuple[float, ...], settings: ProposalSettings) -> PoolProposal:
    """Return the proposal for the estimate."""
    wide = first_mixture(pool.u.shape[1], scales[1:])
    log_wide_weights = StandardNormal(pool.u.shape[1]).log_prob(pool.u) - wide.log_prob(pool.u)
    logs = (pool.log_proposal, pool.log_weights, pool.log_weights - log_wide_weights, pool.log_doubted)
    others = (settings.base_share, settings.wide_share, settings.doubted_share)
    shares = np.array([1 - sum(others), *others])
    return PoolProposal(pool, shares, np.array([normalise_weights(log) for log in logs]), log_wide_weights)
