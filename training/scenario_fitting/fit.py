"""Fit of base distributions to recorded traffic, written as JSON.

    python -m training.scenario_fitting.fit --data DIR --out rare_envs/data
    python -m training.scenario_fitting.fit --highd DIR --out bases

The first line makes the files of the package from events of US 101. The second first extracts the events of your own
recordings: of highD, or with --ngsim, --tgsim, --i24 or --coifman of other formats (docs/data.md).

Events (one per row of a CSV file) are filtered, standardised, and fitted with Gaussian mixtures with full
covariances; the number of components is the one with the least Bayesian information criterion. Back in physical
units the mixture is truncated to the box of the scenario's parameters. The first line also writes the two `highway`
files, which are assembled and not fitted (`training.scenario_fitting.published_highway`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import numpy as np
import typer

from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture
from rare_envs.scenarios.registry import scenario_named
from training.command_line import LocationOption, RecordingOptions, report_errors, run_command, spread_options
from training.data.events import EXTRACTORS, Events, concatenate_events, write_events
from training.data.formats.recordings import load_recordings
from training.data.formats.text_columns import Gaps
from training.data.trajectories import Trajectories
from training.scenario_fitting.event_filters import EVENT_RECIPES, EventRecipe, filter_events, read_events
from training.scenario_fitting.mixture import (
    COVARIANCE_FLOOR,
    EM_STARTS,
    EVENTS_PER_COMPONENT,
    SMALLEST_COMPONENT,
    MixtureFit,
    append_independent,
    mass_outside,
    select_mixture,
)
from training.scenario_fitting.published_highway import build_highway_base

US101_COMMAND = "python -m training.scenario_fitting.fit --data DIR --out rare_envs/data"
"""Command that writes the files of the package."""
OWN_COMMAND = "python -m training.scenario_fitting.fit, with --highd or another option of recordings"
"""Command that writes bases of a user's own recordings."""
US101_SOURCE = {
    "data": "Next Generation Simulation (NGSIM) Vehicle Trajectories and Supporting Data, US 101 "
    "(Los Angeles, southbound, 15 June 2005, 07:50 local time, congested)",
    "publisher": "U.S. Department of Transportation, Federal Highway Administration (FHWA)",
    "record": "8ect-6jqj",
    "licence": "CC BY-SA 3.0 (as the data's public record was reported); these parameters are "
    "derived from the data and are offered under the same licence",
    "changes": "events extracted from the trajectories, filtered as listed, fitted with a mixture",
}
"""Provenance of the events of US 101."""


def format_base(
    scenario: str,
    mixture: TruncatedGaussianMixture,
    provenance: Mapping[str, Any],
    replaced: Mapping[str, Any] = MappingProxyType({}),
) -> str:
    """Return the text of a base distribution file, which `rare_envs.scenarios.base_distributions.load_base` reads.

    Args:
        scenario: Name of the scenario, such as "cut_in".
        mixture: The distribution, in logarithms of those coordinates that are fitted so.
        provenance: Provenance of the distribution.
        replaced: Entries that replace the mixture's own: the box of x, where some coordinates are logarithms.
    """
    content = {
        "names": [p.name for p in scenario_named(scenario).parameters],
        "units": [p.unit for p in scenario_named(scenario).parameters],
        **mixture.to_dict(),
        **replaced,
        "provenance": {**provenance, "mass_outside_box": mass_outside(mixture)},
    }
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def fit_us101_base(scenario: str, data: Path, seed: int = 0, recipe: EventRecipe | None = None) -> str:
    """Return the text of the base file of a scenario fitted to the events of US 101.

    Args:
        scenario: Name of the scenario, such as "cut_in".
        data: Folder with the events files.
        seed: Seed of the fits.
        recipe: Columns and filters of the events; those in `EVENT_RECIPES` if None.
    """
    recipe = EVENT_RECIPES[scenario] if recipe is None else recipe
    return fit_base(scenario, data / recipe.file, US101_SOURCE, US101_COMMAND, seed, recipe)


def fit_base(
    scenario: str, path: Path, source: Mapping[str, str], command: str, seed: int = 0, recipe: EventRecipe | None = None
) -> str:
    """Return the text of the base file of a scenario fitted to a file of events.

    Args:
        scenario: Name of the scenario, such as "cut_in".
        path: CSV file with the columns of the recipe.
        source: Provenance and licence of the events.
        command: Command that writes the file.
        seed: Seed of the fits.
        recipe: Columns and filters of the events; those in `EVENT_RECIPES` if None.

    Raises:
        ValueError: The events cannot be read, or are too few.
    """
    recipe, box = EVENT_RECIPES[scenario] if recipe is None else recipe, scenario_named(scenario).parameters
    (together, own), log = filter_events(read_events(path, recipe), recipe, box)
    low, high = np.array([p.low for p in box]), np.array([p.high for p in box])
    chosen = np.array([column in recipe.logarithmic for column in recipe.columns])
    joint = together.shape[1]
    together[:, chosen[:joint]] = np.log(together[:, chosen[:joint]])
    bottom, top = (np.where(chosen, np.log(np.where(chosen, end, 1.0)), end) for end in (low, high))
    try:
        fit = select_mixture(together, bottom[:joint], top[:joint], seed)
        mixture = fit.mixture
        if recipe.apart:
            own_fit = select_mixture(own, bottom[joint:], top[joint:], seed, most=1)
            mixture = append_independent(mixture, own_fit.mixture)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    box_of_x = {"low": low.tolist(), "high": high.tolist(), "logarithmic": chosen.tolist()} if chosen.any() else {}
    origin = {"source": source, "file": path.name, "command": command}
    return format_base(scenario, mixture, _provenance(recipe, log, fit, seed, origin), box_of_x)


def _provenance(
    recipe: EventRecipe, log: Sequence[Any], fit: MixtureFit, seed: int, origin: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the record of a fit, for the header of its file."""
    return {
        "kind": "fitted to recorded events",
        "source": origin["source"],
        "file": origin["file"],
        "columns": list(recipe.columns),
        "moment": "start of the lane change" if recipe.phase else "first frame of the pair",
        "events_read": log[0]["events"],
        "events_used": {", ".join(e["columns"]): e["events"] for e in log if e["rule"] == "events used"},
        "filters": [entry for entry in log if "dropped" in entry],
        "selection": [
            {
                "components": candidate.components,
                "bic": round(candidate.bic, 2),
                "events_in_smallest": round(candidate.smallest, 1),
                "accepted": candidate.accepted,
            }
            for candidate in fit.candidates
        ],
        "settings": {
            "covariance_floor": COVARIANCE_FLOOR,
            "restarts": EM_STARTS,
            "events_per_component_and_dimension": EVENTS_PER_COMPONENT,
            "smallest_component_per_dimension": SMALLEST_COMPONENT,
            "seed": seed,
        },
        "command": origin["command"],
        "libraries": {name: version(name) for name in ("numpy", "scipy", "scikit-learn")},
    }


def fit_own_bases(
    tables: Iterable[Trajectories], scenarios: Sequence[str], out: Path, name: str, seed: int = 0
) -> None:
    """Extract the events of recordings and fit scenarios to them.

    Writes `<scenario>_events.csv` and `<scenario>_<name>.json` into a folder; `load_base` reads the latter.

    Args:
        tables: The recordings.
        scenarios: Names of the scenarios to fit.
        out: Folder of the files.
        name: Name of the bases.
        seed: Seed of the fits.

    Raises:
        ValueError: A recording is broken, or the events of a scenario are too few; the file of events is written
            nevertheless.
    """
    out.mkdir(parents=True, exist_ok=True)
    names: set[str] = set()
    parts: list[dict[str, Events]] = []
    for table in tables:
        names |= {str(recording) for recording in np.unique(table.recording)}
        parts.append({scenario: EXTRACTORS[scenario](table) for scenario in scenarios})
    source = {
        "data": f"recordings {', '.join(sorted(names))}",
        "licence": "that of the recordings; parameters derived from them may fall under it",
        "changes": US101_SOURCE["changes"],
    }
    files = {scenario: out / f"{scenario}_events.csv" for scenario in scenarios}
    for scenario, path in files.items():
        write_events(concatenate_events([events[scenario] for events in parts]), path)
        typer.echo(path)
    for scenario, path in files.items():
        base = out / f"{scenario}_{name}.json"
        base.write_text(fit_base(scenario, path, source, OWN_COMMAND, seed), encoding="utf-8")
        typer.echo(base)


@dataclass(frozen=True, kw_only=True)
class EventOptions(RecordingOptions):
    """Options that name recordings of which events are extracted."""

    coifman: Annotated[Path | None, typer.Option(help="Or the I-80 data of Coifman and Li, .mat or text.")] = None
    location: LocationOption = None
    between: Annotated[
        tuple[float, float] | None, typer.Option(help="Of I-24 MOTION: first and last Unix time to read [s].")
    ] = None

    KINDS: ClassVar[tuple[str, ...]] = (*RecordingOptions.KINDS, "coifman")


@spread_options
def main(
    out: Annotated[Path, typer.Option(help="Folder for the JSON files.")],
    recordings: EventOptions,
    cut_gaps: Annotated[bool, typer.Option("--cut-gaps", help="Cut tracks where frames are missing.")] = False,
    scenario: Annotated[list[str] | None, typer.Option(help="Of your own recordings: which to fit.")] = None,
    name: Annotated[str, typer.Option(help="Name of the bases of your own recordings.")] = "own",
    seed: Annotated[int, typer.Option(help="Seed of the fits.", min=0)] = 0,
) -> None:
    """Write base distributions: us101 (fitted) and highway (assembled), or those of your own recordings."""
    with report_errors("fit"):
        kind, path = recordings.kind_and_path()
        chosen = tuple(scenario or EVENT_RECIPES)
        if unknown := sorted(set(chosen) - set(EVENT_RECIPES)):
            raise ValueError(f"Unknown scenario {unknown[0]}; known are {', '.join(EVENT_RECIPES)}.")
        gaps: Gaps = "cut" if cut_gaps else "error"
        if kind == "data":
            _write_package_bases(path, out, seed)
        else:
            tables = load_recordings(kind, path, location=recordings.location, between=recordings.between, gaps=gaps)
            fit_own_bases(tables, chosen, out, name, seed)


def _write_package_bases(data: Path, out: Path, seed: int) -> None:
    """Write the bases of the package."""
    texts = {}
    for scenario in EVENT_RECIPES:
        texts[f"{scenario}_us101.json"] = fit_us101_base(scenario, data, seed)
        texts[f"{scenario}_highway.json"] = format_base(scenario, *build_highway_base(scenario))
    out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
        typer.echo(out / name)


if __name__ == "__main__":
    run_command(main)
