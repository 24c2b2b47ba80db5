"""Does the interval for the base distribution hold the true p? Simulated worlds with known p, events drawn anew.

    python -m benchmarks.uncertainty.base_coverage --repetitions 200

In each repetition events are drawn from a world, a Gaussian is fitted to them and 30 times to resampled clusters of
them, p of a half-space under the fit is estimated and `Estimate.base_uncertainty` compared with p of the world: from
the events to the printed interval. Beside it stand the sampling interval alone, and percentiles of the refits. Two
worlds are Gaussian; two have the tails of Student's t with 6 degrees of freedom, which the fitted family does not.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy import stats

import samplers
from benchmarks import RESULTS
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from samplers.problem import FloatArray
from training.fit.coordinates import draw_events
from training.fit.filters import EventSet

COVERAGE_RESULT = RESULTS / "base_coverage.json"
DIM = 3
"""Coordinates of an event."""
REFITS = 30
MAX_SIM = 2000
"""Simulations of an estimate: a half-space needs no more for a c.o.v. of 2 %."""
VARIANCE_FLOOR = 0.01
"""Added to variances of standardised events, as in `training.fit.mixture`."""
BOX = 30.0
"""Half the width of the box of the fitted Gaussians; it cuts off nothing."""
DIRECTION = np.full(DIM, DIM**-0.5)
"""Unit vector towards the failures."""


@dataclass(frozen=True)
class World:
    """Events X in clusters, each N(0, I) or Student's t; a system that fails where X in `DIRECTION` exceeds a limit."""

    events: int
    clusters: int
    correlation: float
    """Of two events of one cluster."""
    p: float = 7e-4
    freedom: float = math.inf
    """Degrees of freedom of Student's t; inf for normal events."""

    @property
    def limit(self) -> float:
        """The value in `DIRECTION` that is exceeded with probability p."""
        return float(stats.t.isf(self.p, self.freedom))

    @property
    def cluster_of(self) -> NDArray[np.int64]:
        """The cluster of each event, shape (events,), of sizes that differ by 1 at most."""
        return np.arange(self.events) % self.clusters

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Return events, shape (events, DIM); those of one cluster share a part of their mean."""
        shared = rng.standard_normal((self.clusters, DIM))[self.cluster_of]
        own = rng.standard_normal((self.events, DIM))
        x = math.sqrt(self.correlation) * shared + math.sqrt(1 - self.correlation) * own
        if math.isinf(self.freedom):
            return x
        return x / np.sqrt(rng.chisquare(self.freedom, (self.events, 1)) / self.freedom)


WORLDS = (
    World(38, 17, 0.2),
    World(400, 40, 0.1),
    World(38, 17, 0.2, freedom=6.0),
    World(400, 40, 0.1, freedom=6.0),
)


def fit_gaussian(x: FloatArray) -> TruncatedGaussianMixture:
    """Return the Gaussian with the moments of events (n, d), a floor under its variances."""
    covariance = np.cov(x, rowvar=False, bias=True) + VARIANCE_FLOOR * np.diag(x.var(axis=0))
    box = np.full(x.shape[1], BOX)
    return TruncatedGaussianMixture(np.ones(1), x.mean(axis=0)[None], covariance[None], -box, box)


def fit_base(x: FloatArray, world: World, rng: np.random.Generator) -> FittedDistribution:
    """Return the fit to the events of a world, and its refits."""
    events = EventSet(x, world.cluster_of, cluster="cluster")
    return FittedDistribution(
        distribution=fit_gaussian(x),
        refits=tuple(fit_gaussian(draw_events(events, rng).joint) for _ in range(REFITS)),
        events=events.counts,
        family="1 component",
    )


def exact_p(base: TruncatedGaussianMixture, limit: float) -> float:
    """Return P[X in DIRECTION > limit] of a Gaussian."""
    mean, variance = DIRECTION @ base.means[0], DIRECTION @ base.covariances[0] @ DIRECTION
    return float(stats.norm.sf(limit, mean, math.sqrt(variance)))


@dataclass(frozen=True)
class Repetition:
    """One draw of events, fitted, estimated and compared with the truth."""

    covered: bool
    """False too where nothing is said, because nothing failed under the fit."""
    below: bool
    """Whether the whole interval lies below the true p."""
    undetermined: bool
    """Whether a bound, which covers what lies below it, or nothing stands in place of the interval."""
    sampling_covered: bool
    percentiles_covered: bool
    """Whether the 2.5 and 97.5 % points of p of the refits hold the true p."""
    log_width: float
    """Logarithm of upper over lower end; NaN without interval."""
    spread: float
    further_run: bool
    log_errors: tuple[float, ...]
    """Error of log p of each refit; empty where nothing is said."""


def repeat(world: World, seed: int) -> Repetition:
    """Draw events from a world, fit, estimate and compare."""
    rng = np.random.default_rng([seed, world.events, world.clusters])
    base = fit_base(world.draw(rng), world, rng)
    problem: Any = SimpleNamespace(dim=DIM, base=base, evaluate=lambda x: world.limit - x @ DIRECTION)
    result = samplers.estimate(problem, seed=seed, max_sim=MAX_SIM)
    return compare_with_truth(result, world.p, np.array([exact_p(refit, world.limit) for refit in base.refits]))


def compare_with_truth(result: samplers.Estimate, p: float, p_refits: FloatArray | None = None) -> Repetition:
    """Return what the intervals of an estimate hold.

    Args:
        result: The estimate under a fitted base.
        p: The true probability.
        p_refits: The exact ones under the refits, shape (refits,), where they are known.
    """
    found = result.base_uncertainty
    assert found is not None
    low, high = found.interval or (0.0, found.bound or math.nan)
    known = not found.reason
    percentiles = np.quantile(found.value_refits, (0.025, 0.975)) if known else (math.nan, math.nan)
    return Repetition(
        covered=low <= p <= high,
        below=high < p,
        undetermined=found.interval is None,
        sampling_covered=result.interval[0] <= p <= result.interval[1],
        percentiles_covered=bool(percentiles[0] <= p <= percentiles[1]),
        log_width=math.log(high / low) if found.interval else math.nan,
        spread=found.spread,
        further_run=result.ensemble_run is not None,
        log_errors=tuple(np.log(found.value_refits) - np.log(p_refits)) if known and p_refits is not None else (),
    )


def summarise(world: World, repetitions: Sequence[Repetition]) -> dict[str, Any]:
    """Return shares and medians over the repetitions of one world, ready for JSON."""
    errors = np.concatenate([each.log_errors for each in repetitions])
    return {
        **{key: value if value != math.inf else None for key, value in asdict(world).items()},
        **summarise_repetitions(repetitions),
        "rms_log_error": float(np.sqrt((errors**2).mean())),
    }


def summarise_repetitions(repetitions: Sequence[Repetition]) -> dict[str, Any]:
    """Return shares and medians over repetitions; a median is None where no repetition has a value."""

    def share(name: str) -> float:
        return float(np.mean([getattr(each, name) for each in repetitions]))

    widths = [each.log_width for each in repetitions if math.isfinite(each.log_width)]
    spreads = [each.spread for each in repetitions if math.isfinite(each.spread)]
    return {
        "repetitions": len(repetitions),
        "covered": share("covered"),
        "below": share("below"),
        "undetermined": share("undetermined"),
        "sampling_covered": share("sampling_covered"),
        "percentiles_covered": share("percentiles_covered"),
        "median_width": math.exp(np.median(widths)) if widths else None,
        "median_spread": float(np.median(spreads)) if spreads else None,
        "further_runs": share("further_run"),
    }


def main(
    repetitions: Annotated[int, typer.Option(help="Draws of events for each world.")] = 200,
    first_seed: Annotated[int, typer.Option(help="Of the first draw.")] = 0,
    out: Annotated[Path, typer.Option(help="Where the result goes.")] = COVERAGE_RESULT,
) -> None:
    """Measure the coverage in every world and write the result."""
    rows = []
    for world in WORLDS:
        seeds = range(first_seed, first_seed + repetitions)
        rows.append(summarise(world, [repeat(world, seed) for seed in seeds]))
        print(json.dumps(rows[-1]), flush=True)
    command = f"python -m benchmarks.uncertainty.base_coverage --repetitions {repetitions} --first-seed {first_seed}"
    out.write_text(json.dumps({"command": command, "worlds": rows}, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
