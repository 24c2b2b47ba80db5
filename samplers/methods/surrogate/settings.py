"""Settings of the method `Surrogate`: the numbers of its stages, each with its reason.

Where no other reason stands beside a number, it was chosen at 300 simulations on two limit states and two driving
scenarios, 2 to 6 seeds each, by which differences in gain of less than a factor of two cannot be told from chance.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class KrigingSettings:
    """The regression of f (`kriging.py`)."""

    smoothness: float = 2.5
    """nu of the Matern covariance: f is taken as twice differentiable."""
    outcome_scale: float = 2.0
    """Outcomes are compressed by arcsinh(y / c) with c = this times the median of |y|, y = f - gamma."""
    tie_share: float = 0.05
    least_ties: int = 3
    """From these shares and numbers of equal largest (least) outcomes on, these are a cap (floor) of f."""
    least_uncensored: int = 5
    """With fewer other outcomes, those at a cap or floor are taken as they are at first."""
    imputations: int = 2
    """Times that outcomes at a cap are replaced by their leave-one-out predictions."""
    most_inflation: float = 3.0
    """Standard deviations are inflated by the root mean square of standardised residuals, but by no more."""
    hyperparameter_steps: int = 25
    """Steps of L-BFGS in each search for covariance parameters."""
    refit_growth: float = 1.4
    """Covariance parameters are searched anew each time the number of points has grown by this factor."""
    most_points: int = 200
    """Points nearest to the limit state that covariance parameters are searched with; a step costs their cube."""


@dataclass(frozen=True, kw_only=True)
class LearningSettings:
    """The points that kriging learns from (`learning.py`)."""

    share: float = 2 / 3
    """Largest share of the budget; a third at least is left for the draws of the estimate."""
    most: int = 300
    """Simulations at most: the cost of kriging grows with their cube."""
    scales: tuple[float, ...] = (1.0, 1.5, 2.2, 3.0)
    """Standard deviations of the first design, a quarter each. At 3 a plane at beta = 4.5 is crossed by one in 15."""
    design_share: float = 0.25
    """Share of the budget in the first design; it has at most `design_least` + `design_per_dim` d points."""
    design_least: int = 30
    design_per_dim: int = 10
    batches: int = 16
    """Batches that the rest of the learning is cut into: simulators run the points of one side by side."""
    least_batch: int = 6
    random_share: float = 0.3
    """Share of a batch that is drawn at random where `Prediction.doubted` leaves both open: points far from where the
    surrogate sees the limit state, which tell whether it is right there."""
    candidates: int = 40
    """Candidates for each point of a batch."""
    most_surprise: float = 1.5
    """Standard errors by which the failures of two batches may differ from those predicted where learning ends early:
    of a surrogate that is wrong at the limit state, all doubtful points fail, or none."""
    forecast_cov: float = 0.02
    """Learning ends where the draws that are left would give this c.o.v., in two batches one after the other."""
    common_share: float = 0.1
    """From this share of failing base draws on, plain Monte Carlo is as good."""


@dataclass(frozen=True, kw_only=True)
class PoolSettings:
    """The pool of draws that the points to simulate are chosen from (`pool.py`); none of them costs a simulation."""

    learning_size: int = 3000
    """Draws of the pool in each batch of learning."""
    final_size: int = 20_000
    """Draws of the last pool; its own error is 1 / sqrt(those that may fail), and part of the c.o.v."""
    final_rounds: int = 3
    """Times that the mixture is fitted anew before the last pool."""
    components: int = 5
    """Gaussians of the mixture at most."""
    fitted_points: int = 800
    """Points drawn from the pool to fit them to."""
    widening: float = 1.2
    """Factor on their standard deviations."""
    shares: tuple[float, float, float] = (0.2, 0.2, 0.6)
    """Shares of base, wide and fitted draws."""


@dataclass(frozen=True, kw_only=True)
class ProposalSettings:
    """What the draws of the estimate are drawn from (`pool.py`); the surrogate has the rest.

    On the IDM cut-in, 300 simulations, 10 seeds: without doubted draws and random points 8 of 10 intervals held p and
    the gain was 34; with doubted draws alone 10 and 76, with both 10 and 190.
    """

    base_share: float = 0.1
    """Share of base draws: no weight exceeds 1 / base_share, but for the error of the pool."""
    wide_share: float = 0.05
    """Share of draws from the wide distributions: they meet regions that the surrogate denies, with small weights."""
    doubted_share: float = 0.15
    """Share of draws where the surrogate would see failures if it were doubted (`Prediction.doubted`)."""


@dataclass(frozen=True, kw_only=True)
class SurrogateSettings:
    """All of them, and those of the estimate."""

    kriging: KrigingSettings = KrigingSettings()
    learning: LearningSettings = LearningSettings()
    pool: PoolSettings = PoolSettings()
    proposal: ProposalSettings = ProposalSettings()
    least_budget: int = 60
    """With fewer simulations all are base draws."""
    most_dims: int = 20
    """In more dimensions `TwoStage` takes over: distances between points say little there."""
    largest_batch: int = 1000
    """Draws of a batch at most, so that a run can be stopped."""
    parts: int = 2
    """Parts that the draws of the estimate come in; the surrogate learns from one before the next is drawn."""
    most_learned: int = 1000
    """Draws of the estimate that the surrogate learns from at most: its cost grows with the cube of their number."""
    target_batch: float = 0.1
    """Draws of a batch as a share of n, where there is a target c.o.v."""
    least_ess: float = 10.0
    """Effective failing draws below which the upper end is Bernstein's bound, which is then near 1."""
    least_skill: float = 0.5
    """Share of the draws proposed by the surrogate that should fail; with less it has little skill, and a warning."""


DEFAULT_SURROGATE_SETTINGS = SurrogateSettings()
