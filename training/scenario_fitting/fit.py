"""Fit of base distributions to recorded traffic, written as JSON.

    rare-envs fit --data DIR --out rare_envs/data
    rare-envs fit --highd DIR --out bases

The first line makes the files of the package from events of US 101, I-80 and I-24. The second first extracts the events
of your own recordings, for car-following, cut-in and hard brake: of highD, or with --ngsim, --tgsim, --i24 or --coifman
of other formats (docs/data.md).

Events are filtered and fitted with Gaussian mixtures with full covariances. The events choose the number of components
(by the Bayesian information criterion) and the coordinates (by that and by the likelihood of events held out). The fit
is repeated on events drawn anew, whole scenes at a time: these refits say what the events are worth. Expected counts of
dangerous states are compared with the recorded ones, and the frequency of the events is counted. All of it is in the
one file of a base.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rare_envs.files import replace_text
from rare_envs.scenarios.registry import scenario_named
from training.command_line import EventOptions, report_errors, run_command, spread_options
from training.data.brakings import hard_brake_events
from training.data.columns import Gaps
from training.data.events import Events, car_following_events, concatenate_events, cut_in_events, write_events
from training.data.formats import load_recordings
from training.data.table import Trajectories
from training.scenario_fitting.base_files import FitRequest, fit_base, format_base
from training.scenario_fitting.event_filters import EVENT_RECIPES, filter_events, read_events
from training.scenario_fitting.fit_progress import FitProgress, ignore_progress
from training.scenario_fitting.own_frequency import ObservedTraffic, count_events
from training.scenario_fitting.published_highway import build_highway_base
from training.scenario_fitting.shipped.bases import SHIPPED_BASES, ShippedBase, name_file
from training.scenario_fitting.shipped.cut_ins import CUT_IN_V0, CUT_IN_V1
from training.scenario_fitting.shipped.following_states import check_against_following

EXTRACTORS = {
    "car_following": car_following_events,
    "cut_in": cut_in_events,
    "hard_brake": hard_brake_events,
}
"""Functions that extract the events of a scenario."""
PACKAGE_COMMAND = "python -m training.scenario_fitting.fit --data DIR --out rare_envs/data"
"""Command that writes the files of the package."""
OWN_COMMAND = "python -m training.scenario_fitting.fit, with --highd or another option of recordings"
"""Command that writes bases of a user's own recordings."""


def fit_shipped_base(base: ShippedBase, data: Path, seed: int = 0, n_refits: int | None = None) -> str:
    """Return the text of the file of a base of the package.

    Args:
        base: One of `SHIPPED_BASES`.
        data: Folder with the compact tables.
        seed: Seed of the fits.
        n_refits: Number of refits, see `refit`.

    Raises:
        ValueError: A table cannot be read.
    """
    events, frequency = base.read(data)
    source = {**base.source, "moment": base.moment}
    request = FitRequest(
        base.scenario, events, source, PACKAGE_COMMAND, frequency, base.system, n_refits=n_refits, seed=seed
    )
    return format_base(base.scenario, fit_base(request).to_dict())


def fit_own_bases(
    tables: Iterable[Trajectories],
    scenarios: Sequence[str] | None,
    out: Path,
    name: str,
    seed: int = 0,
    n_refits: int | None = None,
    progress: FitProgress | None = None,
) -> list[Path]:
    """Extract the events of recordings and fit scenarios to them.

    Writes `<scenario>_events.csv` and `<scenario>_<name>.json` into a folder; `load_base` reads the latter.

    Args:
        tables: The recordings.
        scenarios: Names of the scenarios to fit; None for all that have enough events.
        out: Folder of the files.
        name: Name of the bases.
        seed: Seed of the fits.
        n_refits: Number of refits, see `refit`.
        progress: Is told what is done; None prints nothing of it.

    Returns:
        The files of the bases.

    Raises:
        ValueError: A recording is broken, or the events of all scenarios are too few; the files of events are written
            nevertheless.
    """
    chosen = tuple(EVENT_RECIPES) if scenarios is None else tuple(scenarios)
    out.mkdir(parents=True, exist_ok=True)
    names: set[str] = set()
    traffic = ObservedTraffic()
    parts: list[dict[str, Events]] = []
    for table in tables:
        here = {str(recording) for recording in np.unique(table.recording)}
        names |= here
        if progress:
            progress.say(f"{', '.join(sorted(here))}: {len(table):,} rows read; looking for events")
        traffic = traffic.plus(table)
        parts.append({scenario: EXTRACTORS[scenario](table) for scenario in chosen})
    source = {
        "site": name,
        "data": f"recordings {', '.join(sorted(names))}",
        "licence": "that of the recordings; parameters derived from them may fall under it",
    }
    pooled = {scenario: concatenate_events([events[scenario] for events in parts]) for scenario in chosen}
    files = {scenario: out / f"{scenario}_events.csv" for scenario in chosen}
    for scenario, path in files.items():
        write_events(pooled[scenario], path)
        typer.echo(path)
    too_few, written = [], []
    for scenario, path in files.items():
        recipe = EVENT_RECIPES[scenario]
        events = filter_events(read_events(path, recipe), recipe, scenario_named(scenario).parameters)
        frequency = count_events(scenario, pooled[scenario], len(events.joint), traffic)
        request = FitRequest(scenario, events, source, OWN_COMMAND, frequency, n_refits=n_refits, seed=seed)
        if progress:
            progress.say(f"{scenario}: {len(events.joint):,} events; fitting")
        try:
            base = fit_base(request, ignore_progress if progress is None else progress.counter(scenario))
        except ValueError as error:
            too_few.append(f"{path}: {error}")
            if len(too_few) == len(chosen):
                every = "" if len(chosen) == 1 else f" No base of {', '.join(chosen)} is written: give more recordings."
                raise ValueError(f"{too_few[-1]}{every}") from None
            typer.echo(f"{too_few[-1]} No base of {scenario} is written.", err=True)
            continue
        written.append(_write(out / f"{scenario}_{name}.json", format_base(scenario, base.to_dict())))
        if not base.refits:
            typer.echo(f"{base.fitted_to}: too few to say how far they determine {scenario}; no refits", err=True)
    return written


@spread_options
def main(
    out: Annotated[Path, typer.Option(help="Folder for the JSON files.")],
    recordings: EventOptions,
    cut_gaps: Annotated[bool, typer.Option("--cut-gaps", help="Cut tracks where frames are missing.")] = False,
    scenario: Annotated[
        list[str] | None, typer.Option(help="Which to fit; all that have enough events if none is named.")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the bases of your own recordings.")] = "own",
    refits: Annotated[int | None, typer.Option(help="Refits: 30, or 100 where their components differ.", min=2)] = None,
    seed: Annotated[int, typer.Option(help="Seed of the fits.", min=0)] = 0,
) -> None:
    """Write base distributions: those of the package, or those of your own recordings."""
    with report_errors("fit"):
        fit_bases(
            recordings,
            out,
            cut_gaps=cut_gaps,
            scenarios=scenario,
            name=name,
            n_refits=refits,
            seed=seed,
            progress=True,
        )


def fit_bases(
    recordings: EventOptions,
    out: Path,
    *,
    cut_gaps: bool = False,
    scenarios: Sequence[str] | None = None,
    name: str = "own",
    n_refits: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> list[Path]:
    """Fit base distributions to recordings, or those of the package to its events.

    A scenario with too few events is left out with a line on standard error, unless there is no other.

    Args:
        recordings: Where they are, and of which format.
        out: Folder of the files.
        cut_gaps: Cut tracks where frames are missing.
        scenarios: Names of the scenarios to fit; None for all that have enough events.
        name: Name of the bases.
        n_refits: Number of refits, see `refit`.
        seed: Seed of the fits.
        progress: Whether lines on standard error say how far it has come.

    Returns:
        The files of the bases.

    Raises:
        ValueError: An argument is invalid, a recording is broken, or the events of all scenarios are too few.
        OSError: A file cannot be read or written.
    """
    kind, path = recordings.kind_and_path()
    known = tuple(EVENT_RECIPES)
    if unknown := sorted(set(scenarios or ()) - set(known)):
        raise ValueError(f"Unknown scenario {unknown[0]}; known are {', '.join(known)}.")
    if not name or Path(name).name != name:
        raise ValueError(f"Expected --name as a part of file names, such as cologne, got {name!r}.")
    if kind == "data":
        return _write_package_bases(path, scenarios or known, out, seed, n_refits)
    gaps: Gaps = "cut" if cut_gaps else "error"
    tables = load_recordings(kind, path, location=recordings.location, between=recordings.between, gaps=gaps)
    return fit_own_bases(tables, scenarios, out, name, seed, n_refits, FitProgress() if progress else None)


def _write_package_bases(
    data: Path, scenarios: Sequence[str], out: Path, seed: int, n_refits: int | None
) -> list[Path]:
    """Write the bases of the package, each as soon as it is fitted, and return their files."""
    files = []
    for base in SHIPPED_BASES:
        if scenario_named(base.scenario).name in scenarios:
            text = fit_shipped_base(base, data, seed, n_refits)
            files.append(_write(out / base.file, text))
    for scenario in ("car_following", CUT_IN_V0, CUT_IN_V1):
        if scenario_named(scenario).name in scenarios:
            content = build_highway_base(scenario)
            if scenario == "car_following":
                content = check_against_following(content, data)
            files.append(_write(out / name_file(scenario, "highway"), format_base(scenario, content)))
    return files


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, text)
    typer.echo(path)
    return path


if __name__ == "__main__":
    run_command(main)
