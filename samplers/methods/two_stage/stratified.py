"""Stratified samples: draws from mixtures, a fixed number from each component, and p with its error.

With n_k of n draws from component k and y = weight times indicator of failure, p-hat = sum(y) / n, and its variance is
sum_k n_k var_k(y) / n^2: that between the components, which independent draws of the mixture would add, is none. The
weights are calibrated (`samplers/importance/calibration.py`): what the known mass of each kind of component explains of
y counts no more.
"""

import math
from dataclasses import dataclass

import numpy as np

from samplers.importance.calibration import calibrate
from samplers.importance.draws import Draws
from samplers.methods.two_stage.mixture.proposal import MixtureProposal
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, TwoStageSettings
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FloatArray, Inputs
from samplers.sample import Sample

MAX_LOG_WEIGHT = 700.0
"""exp(709) is the largest number; base draws bound all weights that matter far below."""

MAX_TYPICAL_SHARE = 0.25
"""More in one draw would be met often enough to be seen; a typical weight beyond is of a place without failures."""


@dataclass(frozen=True, eq=False)
class StratifiedSample:
    """Draws from a proposal, with the sums that the variance needs for each component; `add` returns it with more."""

    draws: Draws
    counts: FloatArray
    """Draws of each component, shape (k,)."""
    sums: FloatArray
    """Of what calibration leaves of y in each component, shape (k,)."""
    squares: FloatArray
    """Of its squares, shape (k,)."""
    typical: FloatArray
    """Weight of a typical point of each region, whether or not a draw has met one, shape (m,)."""
    u_safe: FloatArray
    """The draws that did not fail, in the order of `draws.f_safe`, shape (m, d)."""
    settings: TwoStageSettings = DEFAULT_SETTINGS
    """Least draws of a component for a variance, and of a control for calibrated weights."""
    largest_weight: float = 1.0
    """Bound of the weights: 1 over the share of base draws, times the largest calibration factor of a failing draw."""

    @classmethod
    def empty(
        cls, k: int, dim: int, typical: FloatArray, settings: TwoStageSettings = DEFAULT_SETTINGS
    ) -> "StratifiedSample":
        """Return a sample without draws, of a proposal of k components in d dimensions."""
        zero, none = np.zeros(k), Draws(0, np.empty(0), np.empty(0))
        return cls(none, zero, zero, zero, typical, np.empty((0, dim)), settings)

    def add(self, batch: ComponentDraws, proposal: MixtureProposal, inputs: Inputs, gamma: float) -> "StratifiedSample":
        """Return the sample with another batch from the same proposal."""
        fails = batch.f <= gamma
        drawn = proposal.drawn(batch.counts)
        ratios, log_weights = drawn.kind_ratios(batch.u)
        owner, k = np.repeat(np.arange(len(batch.counts)), batch.counts), len(batch.counts)
        calibration = calibrate(ratios, owner, self.settings.draws_per_control)
        y = calibration.residuals(np.where(fails, np.exp(np.minimum(log_weights, MAX_LOG_WEIGHT)), 0.0))
        x = inputs.base.from_standard_normal(batch.u) if batch.x is None else batch.x
        log_weights = log_weights + np.log(calibration.factors)
        largest = float(calibration.factors[fails].max(initial=1.0)) / drawn.weights[0]
        return StratifiedSample(
            self.draws.join(Draws.from_outcomes(batch.f, log_weights, x, gamma)),
            self.counts + batch.counts,
            self.sums + np.bincount(owner, weights=y, minlength=k),
            self.squares + np.bincount(owner, weights=y * y, minlength=k),
            self.typical,
            np.concatenate([self.u_safe, batch.u[~fails]]),
            self.settings,
            max(self.largest_weight, largest),
        )

    def join(self, earlier: "StratifiedSample") -> "StratifiedSample":
        """Return the sample with the draws of an earlier mixture, each weighted as a draw of its own.

        Where the shares of the draws do not depend on outcomes p stays unbiased, and since the later mixture makes an
        unbiased p of whatever came before, the errors of the two are uncorrelated.

        Args:
            earlier: Of another proposal, drawn before this one was made.
        """
        if earlier.draws.n == 0:
            return self
        draws = earlier.draws.join(self.draws)
        return StratifiedSample(
            draws,
            np.concatenate([earlier.counts, self.counts]),
            np.concatenate([earlier.sums, self.sums]),
            np.concatenate([earlier.squares, self.squares]),
            self.typical,
            np.concatenate([earlier.u_safe, self.u_safe]),
            self.settings,
            max(self.largest_weight, earlier.largest_weight),
        )

    @property
    def p(self) -> float:
        """Mean of weight times indicator of failure."""
        return self.draws.p

    @property
    def cov(self) -> float:
        """Coefficient of variation of `p`; inf without a failing draw.

        From the variance within the components. The square of the largest term, met or typical of a region (at most
        MAX_TYPICAL_SHARE of p), is added for draws as heavy as that which have not been met.
        """
        if len(self.draws.f) == 0:
            return math.inf
        many = self.counts >= self.settings.min_stratum_draws
        n, s1, s2 = self.counts[many], self.sums[many], self.squares[many]
        within = float(((s2 - s1 * s1 / n) * n / (n - 1)).sum()) + float(self.squares[~many].sum())
        typical = min(float(self.typical.max(initial=0.0)), MAX_TYPICAL_SHARE * self.draws.n * self.p)
        largest = max(math.exp(float(self.draws.log_weights.max())), typical)
        return math.sqrt(max(within, 0.0) + largest * largest) / (self.draws.n * self.p)

    def to_sample(
        self,
        proposal: MixtureProposal,
        base_f: FloatArray,
        base_u: FloatArray,
        gamma: float,
        counted: Draws | None = None,
    ) -> Sample:
        """Return the weighted points behind p: failing draws as they are, the others together with base draws.

        Thresholds above gamma rest on draws that did not fail. The proposal makes few of those where f is large; base
        draws of the exploration help there, weighted together with them by multiple importance sampling.

        Args:
            proposal: Of these draws.
            base_f: Outcomes of the base draws, shape (n0,).
            base_u: The base draws, shape (n0, d).
            gamma: Threshold of failure.
            counted: All draws that p rests on, whose failing ones are taken: these, and those of earlier proposals if
                any count.
        """
        counted = self.draws if counted is None else counted
        n, n_base = self.draws.n, len(base_f)
        more = base_f > gamma
        u = np.concatenate([self.u_safe, base_u[more]])
        log_base = math.log(n_base) if n_base else -math.inf
        log_density = np.logaddexp(math.log(n) - proposal.drawn(self.counts).log_weights(u), log_base)
        own = np.arange(len(counted.f) + len(self.u_safe))
        return Sample(
            f=np.concatenate([counted.f, self.draws.f_safe, base_f[more]]),
            weights=np.concatenate([np.exp(counted.log_weights) / counted.n, np.exp(-log_density)]),
            units=np.concatenate([own, counted.n + np.flatnonzero(more)]),
            n_units=counted.n + n_base,
            x=counted.x,
        )
