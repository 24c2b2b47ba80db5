"""Base distributions fitted to recorded traffic, written as JSON: what `rare-envs fit` does.

Events of car-following, cut-in and hard brake are extracted from recordings in any of the formats of docs/data.md,
filtered, and fitted with Gaussian mixtures with full covariances. The events choose the number of components (by the
Bayesian information criterion) and the coordinates (by that and by the likelihood of events held out). The fit is
repeated on events drawn anew, whole scenes at a time: these refits say what the events are worth. Expected counts of
dangerous states are compared with the recorded ones, and the frequency of the events is counted. All of it is in the
one file of a base.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer

from rare_envs.distributions.fitted import EventFrequency
from rare_envs.files import replace_text
from rare_envs.scenarios.registry import scenario_named
from training.command_line import EventOptions
from training.data.brakings import braking_exposure, hard_brake_events
from training.data.columns import Gaps
from training.data.events import Events, car_following_events, concatenate_events, cut_in_events, write_events
from training.data.formats import load_recordings
from training.data.table import DT, Trajectories
from training.fit.base import FitRequest, fit_base, format_base
from training.fit.filters import EVENT_DEFINITIONS, EVENT_RECIPES, filter_events, read_events

COMMAND = "rare-envs fit, with --highd or another option of recordings"
EXTRACTORS = {
    "car_following": car_following_events,
    "cut_in": cut_in_events,
    "hard_brake": hard_brake_events,
}
"""Functions that extract the events of a scenario."""
SECONDS_BETWEEN = 5.0
"""A count is printed when the line before it is this old [s], so that a short fit prints few lines."""


class FitProgress:
    """Prints on standard error what a fit is doing, and its counts every few seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with nothing printed; the clock gives the time [s]."""
        self._clock = clock
        self._printed = 0.0

    def say(self, text: str) -> None:
        """Print a line."""
        self._printed = self._clock()
        typer.echo(text, err=True)

    def counter(self, name: str) -> Callable[[str], None]:
        """Return a function that prints a line about what has a name, if the one before it is not too young."""

        def count(text: str) -> None:
            if self._clock() - self._printed >= SECONDS_BETWEEN:
                self.say(f"{name}: {text}")

        return count


@dataclass(frozen=True)
class ObservedTraffic:
    """Time and distance of all vehicles of recordings."""

    hours: float = 0.0
    """Vehicle-hours."""
    km: float = 0.0
    """Vehicle-kilometres."""
    braking_hours: float = 0.0
    """Vehicle-hours in which a braking could begin and be seen."""
    braking_km: float = 0.0
    """Vehicle-kilometres in that time."""

    def plus(self, table: Trajectories) -> ObservedTraffic:
        """Return the traffic with one more recording."""
        seconds, metres = len(table) * DT, float(table.speed.sum()) * DT
        braking_seconds, braking_metres = braking_exposure(table)
        return ObservedTraffic(
            self.hours + seconds / 3600.0,
            self.km + metres / 1000.0,
            self.braking_hours + braking_seconds / 3600.0,
            self.braking_km + braking_metres / 1000.0,
        )


def count_events(scenario: str, events: Events, used: int, traffic: ObservedTraffic) -> EventFrequency | None:
    """Return the frequency of the events of a user's own recordings; None where nothing was recorded to count.

    Cut-ins: lane changes with a vehicle behind in the new lane, times the share of these that the filters keep.
    Car-following: pairs that begin while the ego is in the picture already, times the share that the filters keep.
    Brakings to a standstill: those that are fitted.

    Args:
        scenario: "car_following", "cut_in" or "hard_brake".
        events: Columns of all its events, before the filters.
        used: Events that the filters keep.
        traffic: Of the recordings.
    """
    about: dict[str, Any] = {"source": "counted in the recordings themselves"}
    about["definition"] = EVENT_DEFINITIONS[scenario]
    if scenario == "hard_brake":
        hours, km = traffic.braking_hours, traffic.braking_km
        return EventFrequency(count=used, hours=hours, km=km, **about) if used else None
    if scenario == "car_following":
        count = int((~events["at_entry"]).sum())
    else:
        count = int(((events["phase"] == "start") & (events["ego"] >= 0)).sum())
    if count == 0 or used == 0:
        return None
    about |= {"share": used / count, "share_events": count}
    return EventFrequency(count=count, hours=traffic.hours, km=traffic.km, **about)


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
        request = FitRequest(scenario, events, source, COMMAND, frequency, n_refits=n_refits, seed=seed)
        if progress:
            progress.say(f"{scenario}: {len(events.joint):,} events; fitting")
        try:
            base = fit_base(request, progress.counter(scenario)) if progress else fit_base(request)
        except ValueError as error:
            too_few.append(f"{path}: {error}")
            if len(too_few) == len(chosen):
                every = "" if len(chosen) == 1 else f" No base of {', '.join(chosen)} is written: give more recordings."
                raise ValueError(f"{too_few[-1]}{every}") from None
            typer.echo(f"{too_few[-1]} No base of {scenario} is written.", err=True)
            continue
        written.append(write_base(out / f"{scenario}_{name}.json", format_base(scenario, base.to_dict())))
        if not base.refits:
            typer.echo(f"{base.fitted_to}: too few to say how far they determine {scenario}; no refits", err=True)
    return written


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
        from training.recipes.bases import fit_shipped_bases

        texts = fit_shipped_bases(path, scenarios or known, seed, n_refits)
        return [write_base(out / file, text) for file, text in texts]
    gaps: Gaps = "cut" if cut_gaps else "error"
    tables = load_recordings(kind, path, location=recordings.location, between=recordings.between, gaps=gaps)
    return fit_own_bases(tables, scenarios, out, name, seed, n_refits, FitProgress() if progress else None)


def write_base(path: Path, text: str) -> Path:
    """Write the file of a base, whose folder is made, print its name, and return it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, text)
    typer.echo(path)
    return path
