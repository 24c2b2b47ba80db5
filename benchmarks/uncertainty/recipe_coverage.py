"""Does the whole recipe hold the true p? Coordinates and components chosen, refits, report; worlds with known p.

    python -m benchmarks.uncertainty.recipe_coverage --repetitions 200 --minutes 90

In each repetition events of car-following are drawn from a world, in scenes that share a part of their randomness.
`fit_base` chooses coordinates and components and makes its refits, as for the shipped bases; p of a short time to
collision under the fit is estimated, and `Estimate.base_uncertainty` compared with p of the world. Repetitions of all
worlds take turns, each is a line of a file by seed, and a run goes on where the last one has ended.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
import typer

import samplers
from benchmarks import RESULTS
from benchmarks.uncertainty.base_coverage import Repetition, compare_with_truth, summarise_repetitions
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario
from training.fit.base import fit_base
from training.fit.filters import EventSet

RECIPE_RESULT = RESULTS / "recipe_coverage.json"
RECIPE_LINES = RESULTS / "recipe_coverage.jsonl"
"""Lines of the draws, but for the first of each world, of which the result has the summary alone."""
MAX_SIM = 2000
"""Simulations of an estimate."""
SCENARIO = "car_following"


@dataclass(frozen=True)
class RecipeWorld:
    """Car-following whose distribution is that of a shipped base, and what fails in it."""

    name: str
    base: str
    """Name of the shipped base."""
    components: int
    """1 for a single Gaussian with the moments of the base's mixture."""
    limit: float
    """Inverse of the time to collision above which an event fails [1/s]."""
    events: int
    scenes: int
    correlation: float
    """Of two events of one scene, in standard normal space."""
    p: float = 7e-4
    """Probability of a failure, of 4,000,000 draws: known to 2 %."""

    def truth(self) -> TruncatedGaussianMixture:
        """Return the distribution of the events."""
        base = load_base(find_scenario(SCENARIO), self.base)
        assert isinstance(base, FittedDistribution) and isinstance(base.distribution, TruncatedGaussianMixture)
        return merge_components(base.distribution) if self.components == 1 else base.distribution

    def draw(self, rng: np.random.Generator) -> EventSet:
        """Return events; those of a scene share a part of their standard normal variables."""
        scene = np.arange(self.events) % self.scenes
        shared = rng.standard_normal((self.scenes, 3))[scene]
        own = rng.standard_normal((self.events, 3))
        u = math.sqrt(self.correlation) * shared + math.sqrt(1.0 - self.correlation) * own
        return EventSet(self.truth().from_standard_normal(u), scene, cluster="scene")


RECIPE_WORLDS = (
    RecipeWorld("1 component, closing speed", "us101", 1, 0.3458, 40, 20, 0.2),
    RecipeWorld("3 components, closing speed", "us101", 3, 0.4451, 40, 20, 0.2),
    RecipeWorld("1 component, closing speed", "us101", 1, 0.3458, 400, 40, 0.1),
    RecipeWorld("3 components, closing speed", "us101", 3, 0.4451, 400, 40, 0.1),
    RecipeWorld("3 components, plain gap", "us101-gap", 3, 1.2402, 400, 40, 0.1),
)


def merge_components(mixture: TruncatedGaussianMixture) -> TruncatedGaussianMixture:
    """Return the Gaussian with the mean and covariance of a mixture."""
    mean = mixture.weights @ mixture.means
    apart = mixture.means - mean
    covariance = np.einsum("k,kij->ij", mixture.weights, mixture.covariances + apart[:, :, None] * apart[:, None, :])
    return TruncatedGaussianMixture(np.ones(1), mean[None], covariance[None], coordinates=mixture.coordinates)


@dataclass(frozen=True)
class FittedRepetition:
    """One repetition, and what the recipe chose in it."""

    found: Repetition
    coordinates: str
    components: int
    refits: int


def repeat_recipe(world: RecipeWorld, seed: int, n_refits: int | None = None) -> FittedRepetition:
    """Draw events from a world, choose and fit, estimate and compare.

    Args:
        world: The world.
        seed: Of the draws, the fits and the estimate.
        n_refits: Number of refits; None for that of the recipe.
    """
    events = world.draw(np.random.default_rng([seed, world.events, world.components]))
    base = fit_base(SCENARIO, events, {}, "", n_refits=n_refits, seed=seed)
    problem: Any = SimpleNamespace(dim=3, base=base, evaluate=lambda x: world.limit - (x[:, 0] - x[:, 1]) / x[:, 2])
    result = samplers.estimate(problem, seed=seed, max_sim=MAX_SIM)
    assert isinstance(base.distribution, TruncatedGaussianMixture)
    components = len(base.distribution.weights)
    return FittedRepetition(
        compare_with_truth(result, world.p), base.record["coordinates"], components, len(base.refits)
    )


def summarise_recipe(world: RecipeWorld, repetitions: Sequence[FittedRepetition]) -> dict[str, Any]:
    """Return shares and medians over the repetitions of one world, and how often each choice was made."""
    chosen: dict[str, int] = {}
    for each in repetitions:
        words = f"{each.components}, {each.coordinates}"
        chosen[words] = chosen.get(words, 0) + 1
    return {
        **asdict(world),
        **summarise_repetitions([each.found for each in repetitions]),
        "chosen": dict(sorted(chosen.items(), key=lambda item: -item[1])),
    }


def read_repetition(line: Mapping[str, Any]) -> FittedRepetition:
    """Return the repetition that a line of the file describes."""
    numbers: dict[str, Any] = {name: math.nan if value is None else value for name, value in line["found"].items()}
    found = Repetition(**{**numbers, "log_errors": ()})
    return FittedRepetition(found, line["coordinates"], line["components"], line["refits"])


def write_repetition(world: int, seed: int, repetition: FittedRepetition) -> str:
    """Return the line of a repetition."""
    content = asdict(repetition)
    content["found"] = {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in content["found"].items()
    }
    return json.dumps({"world": world, "seed": seed, **content})


def main(
    repetitions: Annotated[int, typer.Option(help="Draws of events for each world.")] = 200,
    minutes: Annotated[float, typer.Option(help="Time after which no repetition is begun.")] = 60.0,
    world: Annotated[list[int] | None, typer.Option(help="Number of a world to go on with; all if none.")] = None,
    lines: Annotated[Path, typer.Option(help="Where a line for each repetition goes.")] = RECIPE_LINES,
    out: Annotated[Path, typer.Option(help="Where the result goes.")] = RECIPE_RESULT,
) -> None:
    """Measure the coverage in every world, as far as the time allows, and write the result."""
    known = [json.loads(line) for line in lines.read_text().splitlines()] if lines.is_file() else []
    done = {(each["world"], each["seed"]): read_repetition(each) for each in known}
    end = time.monotonic() + 60.0 * minutes
    numbers = world or range(len(RECIPE_WORLDS))
    for seed, number in ((seed, number) for seed in range(repetitions) for number in numbers):
        if (number, seed) in done:
            continue
        if time.monotonic() > end:
            break
        done[number, seed] = repeat_recipe(RECIPE_WORLDS[number], seed)
        with lines.open("a") as file:
            file.write(write_repetition(number, seed, done[number, seed]) + "\n")
    by_world = [[done[key] for key in sorted(done) if key[0] == number] for number in range(len(RECIPE_WORLDS))]
    rows = [summarise_recipe(each, found) for each, found in zip(RECIPE_WORLDS, by_world, strict=True) if found]
    command = f"python -m benchmarks.uncertainty.recipe_coverage --repetitions {repetitions}"
    out.write_text(json.dumps({"command": command, "worlds": rows}, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
