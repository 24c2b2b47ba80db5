"""An ego that is safer by construction, an IDM with a longer headway, under every fitted base and all of its refits.

    python -m benchmarks.uncertainty.safer_ego

The two egos are compared under each base, from the same draws. Whatever the traffic, the longer headway should come out
no less safe: under the base itself and under each refit. And as both p rise and fall together from refit to refit, the
logarithm of their ratio should spread less than that of either.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import rare_envs
import samplers
from benchmarks import RESULTS
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import env_id_of, scenario_named
from samplers.analysis.refits import MIN_REFIT_ESS

SAFER_RESULT = RESULTS / "safer_ego.json"
HEADWAYS = (1.2, 1.4)
"""Time headways of the two egos [s]; the minimum gap and the rest are those of the default IDM."""
SCENARIOS = ("cut_in", "hard_brake", "car_following")


@dataclass(frozen=True)
class SaferRow:
    """What came out under one base."""

    scenario: str
    base: str
    fitted_to: str
    refits: int
    p: tuple[float, float]
    """Of the shorter and the longer headway."""
    ratio: float
    """Shorter over longer."""
    ratio_interval: tuple[float, float] | None
    """95 % by the events; None where they do not determine it."""
    p_interval: tuple[float, float] | None
    """The same of p of the shorter headway."""
    spreads: tuple[float, float]
    """Standard deviation over the refits of log p of each ego."""
    ratio_spread: float
    """The same of the logarithm of the ratio."""
    covered_refits: int
    """Refits under which both p rest on 10 effective failing points or more; the spreads are those over these."""
    safer_refits: int
    """Of these, those under which the longer headway fails no more often."""


def list_fitted_bases() -> Iterator[tuple[str, str]]:
    """Yield scenario and name of each shipped base that has refits."""
    for scenario in SCENARIOS:
        for name in scenario_named(scenario).bases:
            base = load_base(scenario_named(scenario), name)
            if isinstance(base, FittedDistribution) and base.refits:
                yield scenario, name


def measure_base(scenario: str, base: str, max_sim: int, seed: int = 0) -> SaferRow | None:
    """Return what comes out under one base, or None where one of the egos never fails.

    Args:
        scenario: Name of the scenario.
        base: Name of the base.
        max_sim: Simulations of both egos together; the further run under the refits has as many again.
        seed: Of the comparison.
    """
    egos = [rare_envs.IDM(time_headway=headway) for headway in HEADWAYS]
    problems = [rare_envs.DrivingProblem(env_id_of(scenario), ego=ego, base=base) for ego in egos]
    found = samplers.compare(*problems, seed=seed, max_sim=max_sim)
    of_ratio, of_p = found.base_uncertainty, found.either.base_uncertainty
    if of_ratio is None or of_p is None or found.a.p == 0 or found.b.p == 0:
        return None
    ratios, p_either = np.array(of_ratio.ratio_refits), np.array(of_p.p_refits)
    # The longer headway hardly ever fails where the shorter does not, so that P[either fails] is that of the shorter.
    covered = (np.array(of_ratio.ess_refits) >= MIN_REFIT_ESS) & (ratios > 0)
    logs = np.log(p_either[covered]), np.log(p_either[covered] / ratios[covered]), np.log(ratios[covered])
    first, second, both = (float(values.std(ddof=1)) for values in logs)
    return SaferRow(
        scenario=scenario,
        base=base,
        fitted_to=of_ratio.fitted_to,
        refits=len(ratios),
        p=(found.a.p, found.b.p),
        ratio=found.ratio,
        ratio_interval=of_ratio.interval,
        p_interval=of_p.interval,
        spreads=(first, second),
        ratio_spread=both,
        covered_refits=int(covered.sum()),
        safer_refits=int((ratios[covered] >= 1.0).sum()),
    )


def main(
    max_sim: Annotated[int, typer.Option(help="Simulations of both egos together under each base.")] = 8000,
    seed: Annotated[int, typer.Option(help="Of the comparisons.")] = 0,
    scenario: Annotated[list[str] | None, typer.Option(help="Which to measure; the rows of others are kept.")] = None,
    base: Annotated[list[str] | None, typer.Option(help="Which bases of these; the rows of others are kept.")] = None,
    out: Annotated[Path, typer.Option(help="Where the result goes.")] = SAFER_RESULT,
) -> None:
    """Measure bases and write the result."""
    rows = {(row["scenario"], row["base"]): row for row in json.loads(out.read_text())["rows"]} if out.is_file() else {}
    for name, fitted in list_fitted_bases():
        if (scenario and name not in scenario) or (base and fitted not in base):
            continue
        row = measure_base(name, fitted, max_sim, seed)
        if row is None:
            print(f"{name} {fitted}: one of the two never fails", flush=True)
            continue
        values = {key: _null_nan(value) for key, value in asdict(row).items()}
        rows[name, fitted] = {**values, "max_sim": max_sim, "seed": seed}
        print(
            f"{name} {fitted}: ratio {row.ratio:.2g} {row.ratio_interval}, safer in {row.safer_refits} of "
            f"{row.covered_refits} ({row.refits}) refits; spreads {row.spreads[0]:.2f}, {row.spreads[1]:.2f}, "
            f"of the ratio {row.ratio_spread:.2f}",
            flush=True,
        )
        about = {"command": "python -m benchmarks.uncertainty.safer_ego", "headways": HEADWAYS}
        out.write_text(json.dumps({**about, "rows": list(rows.values())}, indent=2) + "\n")


def _null_nan(value: object) -> object:
    """Return None for NaN, which JSON lacks, and anything else as it is."""
    return None if isinstance(value, float) and math.isnan(value) else value


if __name__ == "__main__":
    typer.run(main)
