"""Traffic models fitted to recorded traffic, written as JSON: what `rare-envs fit` does.

Events of car-following, cut-in and hard brake are extracted from recordings in any of the formats of docs/data.md,
filtered, and fitted with Gaussian mixtures with full covariances. The events choose the number of components (by the
Bayesian information criterion) and the coordinates (by that and by the likelihood of events held out). The fit is
repeated on events drawn anew, whole scenes at a time: these refits say what the events are worth. Expected counts of
dangerous states are compared with the recorded ones, and the frequency of the events is counted. All of it is in the
one file of a base.
"""

from __future__ import annotations

import glob
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray

from rare_envs.distributions.events import EventFrequency, describe_checks, describe_motion
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.space import Distribution
from rare_envs.files import replace_text
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import env_id_of, find_scenario
from rare_envs.traffic.state import VEHICLE_LENGTH
from samplers.problem import FloatArray
from training.checkpoints import TrainingInterrupted
from training.command_line import EventOptions
from training.data.columns import Gaps
from training.data.events import (
    Events,
    braking_exposure,
    car_following_events,
    cut_in_events,
    hard_brake_events,
    write_events,
)
from training.data.formats import load_recordings
from training.data.table import DT, Trajectories
from training.fit.base import fit_base, format_base
from training.fit.coordinates import MIN_CLUSTERS
from training.fit.filters import (
    CLUSTER_FRAMES,
    EVENT_DEFINITIONS,
    EVENT_RECIPES,
    EventSet,
    NoSpread,
    filter_events,
    recorded_parameters,
)
from training.fit.strata import (
    NEAR_IF_UNSEEN,
    Neighbours,
    check_events,
    find_neighbours,
    keep_neighbours,
)

COMMAND = "rare-envs fit, with --highd or another option of recordings"
EXTRACTORS = {
    "car_following": car_following_events,
    "cut_in": cut_in_events,
    "hard_brake": hard_brake_events,
}
"""Functions that extract the events of a scenario."""
CUT_IN = "cut_in"
LEAST_NEIGHBOURS = 500
"""Neighbours at random times that a recording of whole traffic has in its first minute."""
TICKS_PER_SECOND = 10
SECONDS_BETWEEN = 5.0
"""A count is printed when the line before it is this old [s], so that a short fit prints few lines."""


def _make_teller(shown: bool) -> Callable[[str, str], None]:
    """Return what prints a name and a text on standard error, texts of one name not too soon after each other."""
    last, printed = "", -math.inf

    def tell(name: str, text: str) -> None:
        nonlocal last, printed
        if name != last or time.monotonic() - printed >= SECONDS_BETWEEN:
            last, printed = name, time.monotonic()
            if shown:
                typer.echo(f"{name}: {text}", err=True)

    return tell


def observe_traffic(table: Trajectories) -> FloatArray:
    """Return vehicle-hours and kilometres, and those of them in which a braking could begin and be seen, shape (4,)."""
    seconds, metres = braking_exposure(np.split(table.x, table.track_starts()[1:]))
    return np.array(
        [len(table) * DT / 3600.0, table.speed.sum() * DT / 1000.0, seconds / 3600.0, metres / 1000.0], dtype=np.float64
    )


def count_events(scenario: str, events: Events, used: int, traffic: FloatArray) -> EventFrequency | None:
    """Return the frequency of events of a user's own recordings; None if nothing was recorded to count.

    Cut-ins: lane changes with a vehicle behind in the new lane, times the share of these that the filters keep.
    Car-following: pairs that begin while the ego is in the picture already, times the share that the filters keep.
    Brakings: those that are fitted. The traffic is the sum of `observe_traffic`.
    """
    about: dict[str, Any] = {"source": "counted in the recordings themselves"}
    about["definition"] = EVENT_DEFINITIONS[scenario]
    hours, km, braking_hours, braking_km = traffic.tolist()
    if scenario == "hard_brake":
        return EventFrequency(count=used, hours=braking_hours, km=braking_km, **about) if used else None
    chosen = ~events["at_entry"] if scenario == "car_following" else (events["phase"] == "start") & (events["ego"] >= 0)
    count = int(chosen.sum())
    if count == 0 or used == 0:
        return None
    return EventFrequency(count=count, hours=hours, km=km, share=used / count, share_events=count, **about)


def observe_neighbours(table: Trajectories) -> tuple[FloatArray, NDArray[Any]]:
    """Return who would be cut in on at every second, see `find_neighbours`, and the half-minute of each."""
    rows = np.flatnonzero((table.frame % TICKS_PER_SECOND == 0) & (table.lane > 0))
    recording = np.unique(table.recording, return_inverse=True)[1].ravel()[rows]
    half = 0.5 * np.where(np.isnan(table.length[rows]), VEHICLE_LENGTH, table.length[rows])
    moment = recording * (int(np.ptp(table.frame)) + 1) + table.frame[rows] - table.frame.min()
    found, own = find_neighbours(
        moment, table.lane[rows], table.x[rows] - half, table.x[rows] + half, table.speed[rows]
    )
    labels = [f"{table.recording[row]} {table.frame[row] // CLUSTER_FRAMES}" for row in rows[own]]
    return found, np.array(labels)


def _choose_neighbours(beside: Sequence[tuple[FloatArray, NDArray[Any]]]) -> Neighbours | Distribution:
    """Return the neighbours of the recordings, or the shipped base where these do not show the traffic around."""
    rows, labels = (np.concatenate(each) for each in zip(*beside, strict=True))
    clusters = np.asarray(np.unique(labels, return_inverse=True)[1].ravel(), dtype=np.int64)
    own = keep_neighbours(CUT_IN, rows, clusters, NEAR_IF_UNSEEN["us101"])
    if len(own.rows) >= LEAST_NEIGHBOURS and own.events.counts.clusters >= MIN_CLUSTERS:
        return own
    few = f"{len(own.rows)} neighbours at random times, of {own.events.counts.clusters} half-minutes"
    typer.echo(f"{CUT_IN}: {few}, are too few; who has not looked is as at US 101", err=True)
    return load_base(find_scenario(CUT_IN), "us101")


def _sort_usable(
    pooled: Mapping[str, Events], tell: Callable[..., None]
) -> tuple[dict[str, EventSet], dict[str, ValueError]]:
    """Return the events that can be fitted, and why the others cannot; a ValueError if all are too much alike."""
    usable, faults = dict[str, EventSet](), dict[str, ValueError]()
    for scenario, events in pooled.items():
        found = filter_events(events, EVENT_RECIPES[scenario], recorded_parameters(scenario))
        tell(scenario, f"{len(found.joint):,} events")
        try:
            usable[scenario] = check_events(scenario, found)
            if left_out := len(found.joint) - len(usable[scenario].joint):
                typer.echo(f"{scenario}: {left_out} left out: {usable[scenario].log[-2]['reason']}", err=True)
        except ValueError as error:
            faults[scenario] = error
    alike = {name: error for name, error in faults.items() if isinstance(error, NoSpread)}
    if alike and not usable:
        raise ValueError(" ".join(f"{name}: {error}" for name, error in alike.items()) + " Nothing is written.")
    return usable, faults


def fit_own_bases(
    tables: Iterable[Trajectories],
    scenarios: Sequence[str] | None,
    out: Path,
    name: str,
    seed: int = 0,
    n_refits: int | None = None,
    progress: bool = False,
) -> list[Path]:
    """Extract the events of recordings, and fit scenarios to them; None for all that have enough events.

    Writes `<scenario>_events.csv` and `<scenario>_<name>.json` into a folder and returns the latter; a ValueError if a
    recording is broken, the events of all scenarios are too few (then the files of events are written), or too few or
    too alike in all (then nothing is written).
    """
    chosen, tell = tuple(scenarios or EVENT_RECIPES), _make_teller(progress)
    names, traffic, parts = set[str](), np.zeros(4), list[dict[str, Events]]()
    beside = list[tuple[FloatArray, NDArray[Any]]]()
    for table in tables:
        here = sorted({*table.recording.tolist()})
        names.update(here)
        tell(", ".join(here), f"{len(table):,} rows read; looking for events")
        traffic += observe_traffic(table)
        parts.append({scenario: EXTRACTORS[scenario](table) for scenario in chosen})
        if CUT_IN in chosen:
            beside.append(observe_neighbours(table))
    source = {
        "site": name,
        "data": f"recordings {', '.join(sorted(names))}",
        "licence": "that of the recordings; parameters derived from them may fall under it",
    }
    pooled: dict[str, Events] = {}
    for scenario in chosen:
        own = [part[scenario] for part in parts]
        pooled[scenario] = {column: np.concatenate([events[column] for events in own]) for column in own[0]}
    usable, faults = _sort_usable(pooled, tell)
    out.mkdir(parents=True, exist_ok=True)
    for scenario in chosen:
        write_events(pooled[scenario], out / f"{scenario}_events.csv")
        typer.echo(out / f"{scenario}_events.csv")
    too_few, written = 0, list[Path]()
    for scenario in chosen:
        path = out / f"{scenario}_events.csv"
        asked: dict[str, Any] = {"n_refits": n_refits, "seed": seed, "report": partial(tell, scenario)}
        try:
            if scenario in faults:
                raise faults[scenario]
            events = usable[scenario]
            if scenario == CUT_IN:
                asked["neighbours"] = _choose_neighbours(beside)
            frequency = count_events(scenario, pooled[scenario], len(events.joint), traffic)
            base = fit_base(scenario, events, source, COMMAND, frequency=frequency, **asked)
        except KeyboardInterrupt:
            rest = " ".join(f"--scenario {each}" for each in chosen[chosen.index(scenario) :])
            raise TrainingInterrupted(
                f"Stopped: {len(written)} of {len(chosen)} bases are written; {rest} --force fits the others."
            ) from None
        except ValueError as error:
            too_few += 1
            words = f"{path}: {error} No base of {{}} is written"
            if too_few == len(chosen):
                raise ValueError(f"{words.format(', '.join(chosen))}: give more recordings.") from None
            typer.echo(f"{words.format(scenario)}.", err=True)
            continue
        _print_checks(scenario, base)
        written.append(_write_base(out / f"{scenario}_{name}.json", format_base(scenario, base.to_dict())))
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
    force: bool = False,
) -> list[Path]:
    """Fit traffic models to recordings, or those of the package to its events; return their files in a folder.

    None of the scenarios stands for all that have enough events; the others are left out with a line on standard error,
    unless there is none. A ValueError or an OSError says which argument, file or recording is wrong; `force` replaces
    files that are there already.
    """
    kind, path = recordings.kind_and_path()
    known = tuple(EVENT_RECIPES)
    scenarios = None if scenarios is None else [_read_scenario(each) for each in scenarios]
    if not name or Path(name).name != name:
        raise ValueError(f"Expected --name as a part of file names, such as cologne, got {name!r}.")
    endings = ("*.json",) if kind == "data" else ("events.csv", f"{glob.escape(name)}.json")
    there = [file for each in scenarios or known for end in endings for file in out.glob(f"{each}_{end}")]
    if there and not force:
        raise ValueError(f"There is {str(there[0])!r} already: choose another folder, or replace it by --force.")
    if kind == "data":
        from training.recipes.bases import fit_shipped_bases

        texts = fit_shipped_bases(path, scenarios or known, seed, n_refits)
        return [_write_base(out / file, text) for file, text in texts]
    gaps: Gaps = "cut" if cut_gaps else "error"
    tables = load_recordings(kind, path, location=recordings.location, between=recordings.between, gaps=gaps)
    return fit_own_bases(tables, scenarios, out, name, seed, n_refits, progress)


def _read_scenario(name: str) -> str:
    """Return the short name of a scenario of which recordings show the events."""
    env_id, found = env_id_of(name), find_scenario(name).name
    newest = {each: env_id_of(each) for each in EVENT_RECIPES}
    if env_id != newest.get(found):
        raise ValueError(f"No base of {env_id} can be fitted to recordings; expected {', '.join(newest.values())}.")
    return found


def _print_checks(scenario: str, base: FittedDistribution) -> None:
    """Print on standard error how a base and the drivers compare with what was recorded."""
    lines = {"recorded / expected": describe_checks(map(asdict, base.checks))}
    lines |= {who: describe_motion(found) for who, found in base.record.get("motion", {}).items()}
    for what, text in lines.items():
        if text:
            typer.echo(f"{scenario}, {what}: {text}", err=True)


def _write_base(path: Path, text: str) -> Path:
    """Write the file of a base, whose folder is made, print its name, and return it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, text)
    typer.echo(path)
    return path
