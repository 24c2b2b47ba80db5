"""EstimateData: what a run has found, before any analysis of it."""

from dataclasses import dataclass, field

from samplers.method import Stepping
from samplers.problem import Distribution, FloatArray
from samplers.sample import Failures, Sample, SimulatedPoints, SimulationIndex
from samplers.trace import Level, Status


@dataclass(frozen=True, kw_only=True)
class EstimateData:
    """The attributes of `samplers.Estimate`, which its analyses read."""

    p: float
    """Estimated probability."""
    interval: tuple[float, float]
    """Interval that should hold the true p with probability `confidence`."""
    confidence: float
    """Nominal coverage of `interval`."""
    cov: float
    """Estimated coefficient of variation of p; inf where p = 0."""
    gamma: float
    """Threshold of failure."""
    n_sim: int
    """Simulated points of the whole run, search included."""
    gain: float
    """Plain Monte Carlo runs for the same c.o.v., divided by n_sim; NaN where p is 0 or 1."""
    status: Status
    """End of the run."""
    warnings: tuple[str, ...]
    """Reasons for which the numbers are doubtful; empty if none is known."""
    remarks: tuple[str, ...] = ()
    """Facts about how the run went that cast no doubt on the numbers, such as a change of method."""
    trace: tuple[Level, ...]
    """One entry per level, iteration or batch."""
    failures: Failures
    """Failing points, the most likely first."""
    method: Stepping
    """The method and its settings."""
    seed: int
    """Seed that gives the same run again."""
    sample: Sample | None = field(default=None, compare=False, repr=False)
    """The weighted points behind p; None if the method cannot give them."""
    base: Distribution | None = field(default=None, compare=False, repr=False)
    """Distribution of X."""
    on_error: str = field(default="raise", repr=False)
    """Treatment of rows on which f raised or gave NaN."""
    base_draws: int = 0
    """Simulations that were independent draws from the base distribution."""
    given: str = ""
    """Condition of p, which the problem holds fixed: its attribute `given`, if it has one."""
    column_names: tuple[str, ...] = field(default=(), compare=False, repr=False)
    """Names of the columns of x, the problem's attribute `column_names`; empty where it has none."""
    choice: str = field(default="", compare=False)
    """Method that `Auto` chose and why; empty where the method was named."""
    chose_another: bool = field(default=False, compare=False, repr=False)
    """Whether that is another method than the usual one, which the text says; `to_dict` has every choice."""
    ensemble_run: "EstimateData | None" = field(default=None, compare=False, repr=False)
    """The further run under the mixture of the refits of the base, where `estimate` needed one."""
    simulations: SimulationIndex | None = field(default=None, compare=False, repr=False)
    """What each simulation was made for, and its weight in p; those of `ensemble_run` come after them."""
    points: SimulatedPoints | None = field(default=None, compare=False, repr=False)
    """All simulations, where `estimate` was told to keep them (`keep_points=True`)."""
    refit_ratios: list[tuple[tuple[object, ...], FloatArray]] = field(default_factory=list, compare=False, repr=False)
    """Density ratios of the refits at the failing points with what they are of, once they were asked for."""
