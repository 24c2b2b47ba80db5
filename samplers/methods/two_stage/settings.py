"""Settings of two-stage: the numbers of its stages, each with its reason.

Users set `TwoStage.n` only. Where no other reason stands beside a number, it was chosen together with the others on the
problems of `benchmarks/estimators/catalogue.py` at 6,000 simulations: some 30 configurations, up to 40 runs each, by
which differences in gain of less than a factor of two cannot be told from chance. Numbers of the
algorithms that fit mixtures stand in `mixture/settings.py`.
"""

from dataclasses import dataclass, field

from samplers.methods.two_stage.mixture.proposal import Kind
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, MixtureSettings
from samplers.methods.two_stage.terms.settings import DEFAULT_TERM_SETTINGS, TermSettings


def _initial_shares() -> dict[Kind, float]:
    return {
        "base": 0.1,
        "wide": 0.05,
        "radial": 0.1,
        "gaussian": 0.5,
        "linear": 0.5,
        "corner": 0.3,
        "explored": 0.2,
        "tempered": 0.25,
        "spread": 0.2,
        "directional": 0.1,
    }


@dataclass(frozen=True, kw_only=True)
class ExplorationSettings:
    """Draws of the exploration (`exploration.py`); their numbers hold for `usual_budget` simulations."""

    usual_budget: int = 6000
    """Up to here sizes grow in proportion to the budget, above with its square root; the rest of the budget is
    for refinement and estimate."""
    base: int = 500
    """Base draws; five levels of a tenth each reach 1e-5 from there."""
    wide: tuple[tuple[float, int], ...] = ((1.5, 120), (2.2, 120), (3.0, 80))
    """Wide draws: (s, number). At s = 3 a half-space at beta = 4.5 is hit by one draw in 15."""
    deep_scale: float = 3.3
    """Where the levels went so far that wide draws should have a larger s than this, there are ..."""
    deep_draws: int = 80
    """... so many more, with that s."""
    depth_ratio: float = 1.45
    """Distance of the levels' end, beta, over s: one draw in 14 is beyond a half-space there."""
    level: int = 250
    """Points of each level of subset simulation; `least_level` where the budget is small."""
    least_level: int = 100
    level_fraction: float = 0.1
    """Conditional probability of a level (Au and Beck 2001)."""
    common_failures: int = 5
    """Failures among the base draws from which on no level is begun, and the second round counts in p: chains start
    from these failures, and one round shows how to describe what is so common."""
    points_per_seed: int = 3
    """Points of a level for each of its seeds at least: chains take two steps or more."""
    initial_scale: float = 0.6
    """First step of the chains of subset simulation, as in `AdaptiveSubsetSimulation`."""
    level_acceptance: float = 0.44
    """Acceptance that it is adapted to (Papaioannou, Betz, Zwirglmaier and Straub, 2015)."""
    max_levels: int = 30
    """Levels at most; the share of the budget ends the descent first unless f ties."""
    starts: int = 24
    """Chains from wide failures at most; `least_starts` where the budget is small."""
    least_starts: int = 10
    level_starts: int = 24
    """The same for failures of subset simulation; they take the place of wide failures that are missing."""
    least_level_starts: int = 6
    bisections: int = 3
    """Steps of a wide failure towards the origin: the edge of the region is then known to an eighth of the way."""
    chain_cost: int = 25
    """Simulations that a chain needs at most before it is sorted: bisection, two walks, points half way."""
    descent_share: float = 0.45
    """Share of the budget after which no further level is begun."""
    share: float = 0.65
    """Share of the budget for the whole exploration."""


@dataclass(frozen=True, kw_only=True)
class LineSettings:
    """Lines of descent (`discovery/lines.py`); numbers of simulations hold for `ExplorationSettings.usual_budget`."""

    n: int = 24
    """Lines. Half of them arrive, as a rule. With 30 the exploration costs 60 to 110 simulations more, and the c.o.v.
    was no smaller on four problems (20 seeds each)."""
    root_share: float = 0.1
    """Share of the base draws that lines start from: higher up they cost more and lead to the same regions."""
    initial_step: float = 0.35
    """First step."""
    acceptance: float = 0.3
    """Share of fresh steps that shall be taken ..."""
    adaptation: float = 0.5
    """... and change of the log step per unit of it."""
    step_range: tuple[float, float] = (0.03, 1.0)
    """Least and largest step."""
    most_tries: int = 3
    """Tries at once of each line where others have arrived, so that the batches do not become small."""
    steps: int = 300
    """Lines that go on, times steps taken, at most: where failures are far off, few lines that arrive are better than
    many that do not."""
    limit: int = 600
    """Simulations after which all lines end."""
    most_arrived: float = 0.6
    """Share of the lines that has arrived when the others are given `patience` times the median time of arrival."""
    patience: float = 2.0
    first_look: int = 450
    """Simulations after which lines are given up if less than `few_arrived` of them have arrived."""
    few_arrived: float = 0.15
    starts: int = 4
    """Lines of each region from which chains start."""
    many_regions: int = 6
    """In more than `SubspaceSettings.high_dim` dimensions lines in so many regions mean a shell or a ring: chains would
    not relax there, and none are run."""


@dataclass(frozen=True, kw_only=True)
class TermsAloneSettings:
    """Searches on single terms of f (`discovery/unexplored_terms.py`)."""

    lines: int = 4
    """Lines of descent, and starts of chains, of each term, as of each region."""
    line_share: float = 0.15
    """Share of what the exploration leaves for lines on terms that were the least somewhere, and failed nowhere."""
    scout_share: float = 0.1
    """The same for terms that were the least nowhere."""
    usual_cost: int = 180
    """Simulations for the lines of a term; of more terms than that allows, some are left out."""
    chain_share: float = 0.15
    """Share of what the exploration leaves for the chains from the ends of the lines."""
    least_density: float = 1e-5
    """Failures that are less likely than the likeliest ones by this factor start no chains: they matter too little."""


@dataclass(frozen=True, kw_only=True)
class RegionSettings:
    """Chains inside the failure region, and how regions are separated (`regions.py`)."""

    initial_step: float = 0.5
    """pCN step before any adaptation."""
    steps: tuple[int, int] = (5, 6)
    """Steps of the chains before and after they are sorted into regions."""
    steps_high_dim: tuple[int, int] = (8, 8)
    """The same above `SubspaceSettings.high_dim` dimensions, where a wide failure has further to go."""
    chain_acceptance: float = 0.35
    """Acceptance that the step is adapted to; Papaioannou, Betz, Zwirglmaier and Straub, 2015, adapt to 0.44."""
    adaptation: float = 0.7
    """Change of the log step per unit of acceptance in the first step; it falls with the root of their number."""
    min_step: float = 0.02
    """Least pCN step."""
    across_factors: tuple[float, float] = (1.1, 0.75)
    """Factors of the step across the given direction after a failing proposal and after another one: in balance at an
    acceptance of ln(1 / 0.75) / ln(1.1 / 0.75) = 0.75, for across the direction fresh draws are nearly always right."""
    min_across: float = 0.05
    """Least step across the given direction."""
    along_factors: tuple[float, float] = (1.05, 0.9)
    """The same along the given direction: in balance at 0.68."""
    many_regions: int = 8
    """Number of regions from which failure may be something like a shell."""
    scattered_share: float = 0.25
    """Where this share of the points is in none of `many_regions` regions, it is."""
    few_points: int = 8
    """So many points or fewer are all compared with each other at once, not region by region."""
    max_regions: int = 16
    """Regions that are separated at most."""
    chains_per_region: tuple[int, int] = (8, 24)
    """Chains of each region at least, in few dimensions and in many."""
    points_per_dim: float = 2.5
    """Points of each region per dimension, within `chains_per_region`: as a covariance and a regression need them."""
    max_replicated: int = 60
    """Chains that are added to reach it at most, over all regions."""
    probes: int = 30
    """Points beside failing ones that show whether f is noisy."""
    probe_distance: float = 1e-6
    """How far beside, in standard deviations: no f of a simulation changes over it, save at jumps or by noise."""
    noisy_share: float = 0.9
    """Where less than this share of the probes fail, f is noisy."""
    late_steps: int = 2
    """Of the steps before sorting, the last ones whose proposals describe f around a region."""
    late_steps_high_dim: int = 4
    """The same above `SubspaceSettings.high_dim` dimensions."""
    direction_r2: float = 0.5
    """From this R^2 on, chains follow the direction in which f falls, else that of their mean."""
    mean_steps: int = 3
    """Last steps of the chains that this mean is of."""
    min_points_per_dim: int = 3
    """With fewer points per dimension around the only region, points of subset simulation join them."""
    lower_share: float = 0.7
    """Share of the points of subset simulation that do, those with the lowest f."""


@dataclass(frozen=True, kw_only=True)
class SlopeSettings:
    """Gradients of f by finite differences (`discovery/slopes.py`)."""

    min_dim: int = 15
    """Dimensions from which on they are sought: with fewer, chains show as much."""
    share: float = 0.22
    """Share of what the exploration leaves for them at most: 17 gradients in 40 dimensions at 6,000 simulations."""
    high_dim_share: float = 0.3
    """The same above `SubspaceSettings.high_dim` dimensions, where a component has one direction without slopes, and
    where the regions are pieces of something like a shell."""
    least: int = 4
    """Gradients that two directions can be told from many with."""
    most: int = 20
    """Gradients at most. With 12, one of the three directions of screen_d40 was not found in one run of 24."""
    step: float = 0.05
    """Of a finite difference, in standard deviations: over it f bends little, and rounding does not matter."""
    few: float = 0.65
    """The directions are few where the gradients are worth so many equal directions, over those that as many random
    gradients would be worth. On the shell sphere_d20 1, on series6_d25 0.55, on oscillator_d100 0.4."""
    explained: float = 0.99
    """Share of the squares of new gradients in directions known before, from which on no more gradients are made."""
    least_part: float = 0.005
    """Share of the gradients' squares that a direction must hold: noise of f bends gradients less."""
    most_axes: int = 12
    """Directions at most. With 8, the c.o.v. of duffing_d60 was 0.21 for 0.15 (24 runs each)."""


@dataclass(frozen=True, kw_only=True)
class RefinementSettings:
    """Rounds of draws, and the shares of the components in a proposal (`refinement.py`, `candidates.py`)."""

    round_shares: tuple[float, ...] = (0.09, 0.12, 0.14)
    """Share of what the exploration leaves that each round draws; the rest is for the estimate."""
    counted_from: int = 2
    """Rounds that do not count in p, the first ones: their proposals may not describe the failures yet. The draws of
    the third were worth 0.8 to 1.6 times as much as as many of the last ones, on four problems (30 runs each)."""
    further_shares: tuple[float, ...] = (0.14, 0.14)
    """The same of further rounds, while the last one is worth less than `good_rate`."""
    good_rate: float = 0.1
    """Independent failures for each draw of a round with which its proposal describes the failures."""
    base_share: float = 0.05
    """Least share of base draws: no weight exceeds 20."""
    noisy_base_share: float = 0.1
    """The same where f is noisy."""
    tempered_share: float = 0.1
    """Least share of tempered Gaussians, dealt out among the regions by the roots of their shares of the failures. The
    best weights for the failures met so far may leave a region hardly any: without this the variance of a draw was 1.2
    times as large on common3_d9 and banana_d8, and 2.1 times on loads_d7 (20 runs each)."""
    extra_tempered_share: float = 0.2
    """How much more of them, times the share of the draws from sharp components that did not fail; not where the
    regions are pieces of a shell, for the spread component is wider."""
    noisy_tempered_share: float = 0.5
    """Least share of tempered Gaussians where f is noisy; q^(1/2) phi^(1/2) is then the best proposal."""
    region_share: float = 0.5
    """Share of the draws of a round that is dealt out evenly among the regions. Weights of a region's first draws can
    be so uneven that it seems to have no mass: it must not be lost by that."""
    final_region_share: float = 0.2
    """The same for the estimate."""
    radial_share: float = 0.05
    """Least share of radial components in few dimensions, and wherever the regions are no more than pieces of a shell:
    they reach failures beside the regions, of which one draw would outweigh all others. In 160 runs of `CutIn-v0` with
    its base `us101-15-offsets` 0, 2, 5 and 10 % had gains of 135, 219, 320 and 242."""
    radial_dim: int = 20
    """Few dimensions. In 25 (series6, 60 runs) it took the coverage from 93 to 87 % and the gain from 48 to 5."""
    spread_share: float = 0.4
    """Share of the component that is as wide as the failures in the span of the slopes, where the regions are pieces of
    a shell, or while draws are worth less than `good_rate`: there the failures form a ring, and Gaussians fitted to
    some of them leave gaps. Without it the second moment on oscillator_d100 was 800 to 2,000 times p^2, with it 40 to
    70, and 26 with the half-spaces of the pieces of f; with 0.15 of it these gave 150."""
    explored_share: float = 0.01
    """Share that components from the exploration keep until the last round."""
    min_share: float = 0.004
    """Components with less of the draws are left out."""
    initial_shares: dict[Kind, float] = field(default_factory=_initial_shares)
    """Shares of the kinds where nothing is known yet; of those present, in proportion.

    What a kind is worth, on ten problems of the catalogue with 4 seeds each: without it the stated variance (median) is
    131 times as large on sphere_d20 (radial), 15 times on two_d30 and 4 times on three_d6 and steps_d6 (linear). On
    twelve others with 2 seeds it is 1.6 times as large without `corner`, 20 times on corner_d5. Without `explored` 5 of
    40 intervals miss p, with it none. Without `tempered` the variance is a quarter smaller: they are for noise, and for
    regions that are badly described. `wide` buys nothing over all (1.02 +- 0.05, 168 runs on 48 limit
    states): it guards the coverage on loads_d7 and crossing_d6."""
    wide_scale: float = 1.5
    """Standard deviation of the wide component."""
    tempering: tuple[float, ...] = (0.5,)
    """Powers t of q^t phi^(1 - t)."""
    noisy_tempering: tuple[float, ...] = (0.5, 0.25)
    """The same where f is noisy."""
    gaussians_per_region: int = 3
    """Gaussians fitted to the chains of a region at most: it has some dozens of them."""
    noisy_gaussians: int = 8
    """The same where f is noisy: all of it is one region then."""
    points_per_chain: float = 2.0
    """Independent points that a chain is worth."""
    min_refit_failures: int = 6
    """Failures, all in all, from which on Gaussians and half-spaces are fitted again."""
    min_radial_failures: int = 20
    """Failures that a radial component needs."""
    min_log_ratio: float = 1.0
    """A draw belongs to the region whose Gaussian has the largest density there, if that is e times phi or more."""
    probit_scale: float = 1.702
    """Log odds over the argument of Phi that is next to them: noise is near normal, and the logistic curve has far
    heavier tails (Camilli, "Origin of the scaling constant d = 1.7 in item response theory", 1994)."""
    logistic_penalty: float = 100.0
    """Inverse strength of the penalty (C of scikit-learn): hardly any."""
    logistic_iterations: int = 2000
    """More than the noisy problems of the catalogue need; scikit-learn warns where it is too few."""
    quadratic_dim: int = 20
    """Dimension up to which the log odds of failure are quadratic in u, not linear: 231 coefficients at most."""


@dataclass(frozen=True, kw_only=True)
class FallbackSettings:
    """When a proposal is given up for subset simulation (`fallback.py`)."""

    min_fallback_budget: int = 300
    """Simulations under which subset simulation is not worth it."""
    early_rates: tuple[float, ...] = (0.005, 0.006)
    """What each draw of the first rounds must be worth, in independent failures. Less cannot be told from chance; with
    0.008 and more, proposals are given up that are several times better by the third round."""
    sloped_rate: float = 0.25
    """Share of these rates that is enough where components lie in the span of slopes: their draws leave few places
    out, so that the weights met are about as uneven as all of them."""
    relative_rate: float = 0.04
    """The same for the last round, times the levels: subset simulation has an independent failure for each 100 levels
    simulations, and the weights that were met are about four times flatter than all of them."""
    max_typical: float = 30.0
    """How many times p a typical point of most regions may weigh as a draw: 1 to 3 is usual, 17 was seen to do.
    From `RefinementSettings.good_rate` on it does not apply."""
    chain_points: float = 30.0
    """Points of a level at p0 = 0.1 for one that is independent: (1 - p0) / p0, and correlation along the chains."""
    level_share: float = 0.9
    """Share of a level that is simulated; its seeds, p0 = 0.1 of it, are not simulated again."""
    min_levels: int = 2
    """Levels to plan for at least."""
    min_points: int = 10
    """Points of a level at least."""


@dataclass(frozen=True, kw_only=True)
class DiagnosticSettings:
    """When an estimate is doubted (`diagnostics.py`)."""

    false_alarm: float = 1e-3
    """Probability with which a check of the base draws warns of a right estimate."""
    max_deviation: float = 4.0
    """Standard errors between the rounds and the estimate; a normal distribution exceeds it once in 16,000 runs."""
    min_rounds_ess: float = 30.0
    """Independent failures that the rounds must be worth to be compared."""
    min_final_rate: float = 0.025
    """Independent failures for each final draw; with less, there may be heavier weights than any met."""
    max_point_share: float = 0.25
    """Share of p that a typical point of a region may stand for as a draw."""
    max_unseen_share: float = 0.3
    """Share of p that may be in regions that were not found."""


@dataclass(frozen=True, kw_only=True)
class TwoStageSettings:
    """All settings of a run."""

    min_exploration_budget: int = 400
    """With fewer simulations an exploration is not worth its draws."""
    sufficient_budget: int = 1500
    """With fewer, one of two like regions is missed in 3 to 30 % of runs, without any sign."""
    common_share: float = 0.1
    """Where this share of the base draws fails, plain Monte Carlo is as good as anything."""
    monte_carlo_batch: int = 10_000
    """Base draws of a batch of plain Monte Carlo."""
    target_batches: int = 10
    """With a target c.o.v., a batch of the estimate is the budget divided by this ..."""
    min_target_batch: int = 100
    """... but at least so many draws."""
    max_batches: int = 100
    """Batches after which a target c.o.v. is given up where max_sim does not say."""
    min_stratum_draws: int = 10
    """Of components with fewer draws the second moment stands in for the variance: that of a handful is worth
    nothing."""
    draws_per_control: int = 30
    """Draws of a round for each kind of component from which on their weights are calibrated: with fewer the bias by
    estimated slopes would count."""
    exploration: ExplorationSettings = ExplorationSettings()
    lines: LineSettings = LineSettings()
    terms_alone: TermsAloneSettings = TermsAloneSettings()
    regions: RegionSettings = RegionSettings()
    slopes: SlopeSettings = SlopeSettings()
    refinement: RefinementSettings = RefinementSettings()
    fallback: FallbackSettings = FallbackSettings()
    diagnostics: DiagnosticSettings = DiagnosticSettings()
    mixture: MixtureSettings = DEFAULT_MIXTURE_SETTINGS
    terms: TermSettings = DEFAULT_TERM_SETTINGS


DEFAULT_SETTINGS = TwoStageSettings()
