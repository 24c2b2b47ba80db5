"""How much hangs on the model of gaps? Plain against logarithmic gaps in the fitted base distributions.

    python -m benchmarks.driving.gap_models EVENTS

EVENTS is the folder with the events that `training.scenario_fitting.fit` reads. Prints, for both scenarios and both
models, the BIC of the joint fit in common units, the components, and the IDM ego's collision probability.
"""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import typer

import rare_envs
from rare_envs.distributions.coordinate_mixture import CoordinateMixture
from rare_envs.scenarios.registry import scenario_named
from rare_envs.threads import use_one_thread
from training.scenario_fitting.event_filters import EVENT_RECIPES, filter_events, read_events
from training.scenario_fitting.fit import fit_us101_base

GAPS = {"car_following": ("gap",), "cut_in": ("gap_ego_cutin", "gap_cutin_lead")}
GAP_ENV_IDS = {"car_following": "rare_envs/CarFollowing-v0", "cut_in": "rare_envs/CutIn-v0"}


@use_one_thread()
def main(data: Path, rollouts: int = 1_000_000, seed: int = 0) -> None:
    """Fit, compare, and simulate."""
    for scenario, gaps in GAPS.items():
        for logarithmic in ((), gaps):
            recipe = replace(EVENT_RECIPES[scenario], logarithmic=logarithmic)
            (events, _), _ = filter_events(
                read_events(data / recipe.file, recipe), recipe, scenario_named(scenario).parameters
            )
            columns = [recipe.columns.index(gap) for gap in logarithmic]
            # the density of x is that of the standardised coordinates times the Jacobian of getting there
            jacobian = np.log(events[:, columns]).sum()
            events[:, columns] = np.log(events[:, columns])
            jacobian += len(events) * np.log(events.std(axis=0)).sum()
            text = fit_us101_base(scenario, data, recipe=recipe)
            content = json.loads(text)
            best = min(c["bic"] for c in content["provenance"]["selection"] if c["accepted"])
            with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
                file.write(text)
                file.flush()
                problem = rare_envs.DrivingProblem(GAP_ENV_IDS[scenario], base=file.name)
            assert isinstance(problem.base, CoordinateMixture) == bool(logarithmic)
            f = problem.evaluate(problem.base.sample(rollouts, np.random.default_rng(seed)))
            p = float((f <= 0.0).mean())
            print(
                f"{scenario:14s} {'log' if logarithmic else 'plain':6s} events {len(events)} "
                f"components {len(content['weights'])} BIC {best + 2.0 * jacobian:.1f} "
                f"p {p:.3g} +- {(p * (1.0 - p) / rollouts) ** 0.5:.1g}",
                flush=True,
            )


if __name__ == "__main__":
    typer.run(main)
