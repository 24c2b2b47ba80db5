"""Samples of two-stage and what is doubted in them: all draws by multiple importance sampling, the estimate stratified.

Multiple importance sampling: draws of several proposals, weighted as draws from the mixture of all of them.

With n_k draws from component q_k and n in all, every draw has the weight phi / sum_k (n_k / n) q_k (deterministic
mixture weights, the balance heuristic): no weight is larger than n / n_0 where n_0 draws are from phi itself.

Stratified samples: draws from mixtures, a fixed number from each component, and p with its error.

With n_k of n draws from component k and y = weight times indicator of failure, p-hat = sum(y) / n, and its variance is
sum_k n_k var_k(y) / n^2: that between the components, which independent draws of the mixture would add, is none. The
weights are calibrated (`samplers/importance.py`): what the known mass of each kind of component explains of
y counts no more.

References:
    Veach and Guibas, "Optimally combining sampling techniques for Monte Carlo rendering", SIGGRAPH 1995.
    Owen and Zhou, "Safe and effective importance sampling", JASA 95, 2000.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import bdtrc

from samplers.importance import Draws, calibrate
from samplers.methods.base import ComponentDraws
from samplers.methods.two_stage.mixture import MixtureProposal
from samplers.methods.two_stage.regions import Discovery
from samplers.methods.two_stage.settings import DOUBT
from samplers.problem import FloatArray, Inputs
from samplers.proposals import MixtureComponent, log_ratios, mixture_log_ratio
from samplers.sample import Sample, effective_sample_size


@dataclass(frozen=True, eq=False)
class MultipleImportanceSample:
    """All draws of a run from known components; `add` returns the sample with another batch.

    Later proposals depend on earlier draws, so that p from these weights is biased low by some per cent: they serve to
    fit the next proposal and for a run that is stopped early, not for the estimate.
    """

    u: FloatArray
    """The failing draws, shape (k, d)."""
    log_weights: FloatArray
    """log(phi / q) - log(n) at the failing draws, shape (k,): their exponentials add up to an estimate of p."""
    batches: tuple[ComponentDraws, ...] = ()
    components: tuple[MixtureComponent, ...] = ()
    """Those drawn from, one for each batch that it was part of."""
    counts: FloatArray = field(default_factory=lambda: np.empty(0))
    """Draws of each of `components`."""

    @classmethod
    def empty(cls, dim: int) -> "MultipleImportanceSample":
        """Return a sample without draws in d dimensions."""
        return cls(np.empty((0, dim)), np.empty(0))

    def add(self, batch: ComponentDraws, gamma: float) -> "MultipleImportanceSample":
        """Return the sample with another batch; the failing ones are those with f <= gamma."""
        used = tuple(c for c, n in zip(batch.components, batch.counts, strict=True) if n > 0)
        used_counts = batch.counts[batch.counts > 0].astype(np.float64)
        components, counts = self.components + used, np.concatenate([self.counts, used_counts])
        failing = batch.u[batch.f <= gamma]
        known = np.logaddexp(-self.log_weights, mixture_log_ratio(log_ratios(used, self.u), used_counts))
        added = mixture_log_ratio(log_ratios(components, failing), counts)
        return MultipleImportanceSample(
            np.concatenate([self.u, failing]), -np.append(known, added), (*self.batches, batch), components, counts
        )

    def within(self, axes: FloatArray) -> "MultipleImportanceSample":
        """Return the failing draws alone, in the coordinates of orthonormal axes (d, r)."""
        return MultipleImportanceSample(self.u @ axes, self.log_weights)

    def all_draws(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return all draws, failing or not: u (n, d), f (n,) and log(phi / q) - log(n), shape (n,)."""
        u = np.concatenate([batch.u for batch in self.batches])
        f = np.concatenate([batch.f for batch in self.batches])
        return u, f, -mixture_log_ratio(log_ratios(self.components, u), self.counts)


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
    largest_weight: float = 1.0
    """Bound of the weights: 1 over the share of base draws, times the largest calibration factor of a failing draw."""

    @classmethod
    def empty(cls, k: int, dim: int, typical: FloatArray) -> "StratifiedSample":
        """Return a sample without draws, of a proposal of k components in d dimensions."""
        zero, none = np.zeros(k), Draws(0, np.empty(0), np.empty(0))
        return cls(none, zero, zero, zero, typical, np.empty((0, dim)))

    def add(self, batch: ComponentDraws, proposal: MixtureProposal, inputs: Inputs, gamma: float) -> "StratifiedSample":
        """Return the sample with another batch from the same proposal."""
        fails = batch.f <= gamma
        drawn = proposal.drawn(batch.counts)
        ratios, log_weights = drawn.kind_ratios(batch.u)
        owner, k = np.repeat(np.arange(len(batch.counts)), batch.counts), len(batch.counts)
        calibration = calibrate(ratios, owner, 30)  # slopes of fewer draws for each control bias
        weights = np.exp(np.minimum(log_weights, 700.0))  # exp(709) is the largest number; base draws bound them
        y = calibration.residuals(np.where(fails, weights, 0.0))
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
            max(self.largest_weight, largest),
        )

    def join(self, earlier: "StratifiedSample") -> "StratifiedSample":
        """Return the sample with the draws of an earlier mixture, each weighted as a draw of its own.

        If the shares of the draws do not depend on outcomes p stays unbiased, and since the later mixture makes an
        unbiased p of whatever came before, the errors of the two are uncorrelated.
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
        `DOUBT.max_point_share` of p), is added for draws as heavy as that which have not been met.
        """
        if len(self.draws.f) == 0:
            return math.inf
        many = self.counts >= 10  # a handful has no variance: its second moment stands in
        n, s1, s2 = self.counts[many], self.sums[many], self.squares[many]
        within = float(((s2 - s1 * s1 / n) * n / (n - 1)).sum()) + float(self.squares[~many].sum())
        typical = min(float(self.typical.max(initial=0.0)), DOUBT.max_point_share * self.draws.n * self.p)
        largest = max(math.exp(float(self.draws.log_weights.max())), typical)
        return math.sqrt(max(within, 0.0) + largest * largest) / (self.draws.n * self.p)

    def to_sample(
        self, proposal: MixtureProposal, base_f: FloatArray, base_u: FloatArray, gamma: float, counted: Draws
    ) -> Sample:
        """Return the weighted points behind p: failing draws as they are, the others together with base draws.

        Thresholds above gamma rest on draws that did not fail. The proposal makes few of those where f is large; base
        draws of the exploration (n0, d) help there, weighted together with them by multiple importance sampling. The
        failing ones are those of `counted`, all draws that p rests on.
        """
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


def check_base_draws(p: float, hits: int, n: int) -> list[str]:
    """Return a warning if more of n base draws failed than an estimate p allows, by a binomial test.

    Base draws do not depend on the proposal: they hit a missed region as often as any other of its probability.
    """
    if hits == 0 or bdtrc(hits - 1, n, min(p, 1.0)) > DOUBT.false_alarm:
        return []
    expected = n * p
    return [f"{hits} of {n:,} base draws failed, but p = {p:.2e} predicts {expected:.2g}: a failure region was missed."]


def check_rounds(final: StratifiedSample, rounds: Sequence[Draws]) -> list[str]:
    """Return a warning if the rounds before, each weighted by its own proposal, contradict the estimate.

    Weighted as draws from the mixture of all rounds' proposals they would be worth more, but give a p that is often too
    low by a third, for later proposals depend on earlier draws.
    """
    n = sum(draws.n for draws in rounds)
    log_weights = np.concatenate([np.empty(0), *(draws.log_weights for draws in rounds)])
    if len(final.draws.f) == 0 or effective_sample_size(log_weights) < 30.0:
        return []
    w = np.exp(log_weights)
    before, error = float(w.sum()) / n, math.sqrt(float((w * w).sum())) / n
    apart = abs(before - final.p) / math.hypot(error, final.cov * final.p)
    if apart < DOUBT.max_deviation:
        return []
    return [f"The search rounds give p = {before:.2e}, {apart:.1f} standard errors from the final estimate."]


def check_regions(final: StratifiedSample) -> list[str]:
    """Return a warning if a likely state of the chains in some region would be a large share of p as a draw.

    The proposal does not describe such a region, and that the final draws met hardly any of that weight says nothing.
    """
    share = final.typical / max(final.draws.n * final.p, 1e-300)
    lost = int((share > DOUBT.max_point_share).sum())
    if lost == 0 or len(final.draws.f) == 0:
        return []
    return [
        f"The proposal barely covers {lost} of {len(share)} regions found: one draw there adds {share.max():.0%} of p."
    ]


def describe_discovery(p: float, high: float, raised: float, discovery: Discovery, confidence: float) -> list[str]:
    """Return a remark if much of p may be unseen, and the interval is mostly what that adds to it.

    `raised` is its upper limit with the unseen share, `high` the one without.
    """
    share = discovery.unseen_share(confidence)
    if share <= DOUBT.max_unseen_share or high * high > p * raised:
        return []
    size = f"with probability up to {p * share / (1 - share):.1e} ({share:.0%} of p)"
    return [
        f"Searches that reached failure: {discovery.searches:.0f}, failure regions found: {discovery.regions}; further "
        f"failure regions {size} cannot be excluded, and the interval includes them."
    ]
