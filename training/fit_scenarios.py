"""Fits base distributions to recorded traffic and writes them as JSON.

    python -m training.fit_scenarios --data DIR --out rare_envs/data
    python -m training.fit_scenarios --highd DIR --out bases

The first line makes the files of the package from events of US 101. The second extracts the events of your own
recordings first: of highD, or with --ngsim of raw NGSIM.

Events (one per row of a CSV file) are filtered, standardised, and fitted with Gaussian mixtures with
full covariances; the number of components is the one with the least Bayesian information criterion.
Back in physical units the mixture is cut to the box of the scenario's parameters. The first line also
writes the two `highway` files, which are assembled and not fitted (`training.highway_base`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from pyarrow import ArrowInvalid, csv
from scipy.special import ndtr
from sklearn.mixture import GaussianMixture

from rare_envs.distributions import TruncatedGaussianMixture
from rare_envs.scenarios import named
from rare_envs.space import Parameter
from training.data.events import EXTRACTORS, Events, pooled, write_events
from training.data.highd import highd_recordings, load_highd
from training.data.ngsim import load_ngsim
from training.data.reading import Gaps
from training.data.table import Trajectories
from training.highway_base import highway_base

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

COMMAND = "python -m training.fit_scenarios --data DIR --out rare_envs/data"
OWN_COMMAND = "python -m training.fit_scenarios, with --highd or --ngsim"
SOURCE = {
    "data": "Next Generation Simulation (NGSIM) Vehicle Trajectories and Supporting Data, US 101 "
    "(Los Angeles, southbound, 15 June 2005, 07:50 local time, congested)",
    "publisher": "U.S. Department of Transportation, Federal Highway Administration (FHWA)",
    "record": "8ect-6jqj",
    "licence": "CC BY-SA 3.0 (as the data's public record was reported); these parameters are "
    "derived from the data and are offered under the same licence",
    "changes": "events extracted from the trajectories, filtered as listed, fitted with a mixture",
}
MAX_COMPONENTS = 5
EVENTS_PER_COMPONENT = 10  # times d: no more components are tried than there are events for
SMALLEST_COMPONENT = 5  # times d: a component on fewer events has collapsed on a handful of them
COVARIANCE_FLOOR = 0.01  # added to variances of standardised data: a tenth of a standard deviation
RESTARTS = 20
MASS_SAMPLES = 1_000_000


@dataclass(frozen=True)
class Recipe:
    """Where the parameters of a scenario are found in an events file."""

    file: str
    columns: tuple[str, ...]
    """Columns in the order of the scenario's parameters."""
    apart: tuple[str, ...] = ()
    """The last of the columns, if they are fitted apart: independent of the others, from events of their own."""
    required: tuple[str, ...] = ()
    """Columns of truth values that must hold for the columns apart."""
    logarithmic: tuple[str, ...] = ()
    """Columns whose logarithms are fitted."""
    phase: str | None = None
    """Rows kept by the column `phase`; None where the file has no such column."""


RECIPES = {
    "car_following": Recipe("us101_car_following_events.csv", ("v_ego", "v_lead", "gap")),
    "cut_in": Recipe(
        "us101_cut_in_events.csv",
        ("v_ego", "v_cutin", "v_lead", "gap_ego_cutin", "gap_cutin_lead", "lateral_offset"),
        apart=("lateral_offset",),
        required=("start_seen",),
        # So few events allow one component only, and one normal law cannot be skewed as gaps are: fitted to plain
        # gaps it has a BIC 63 higher, a quarter of its mass outside the box, and puts vehicles at gaps never seen.
        logarithmic=("gap_ego_cutin", "gap_cutin_lead"),
        phase="start",
    ),
}
REASONS = {
    "missing": "no ego behind or no lead ahead was recorded, so the parameter has no value",
    "start_seen": "the track began during the lane change: speeds and gaps are as good as any, but the vehicle had "
    "already moved across",
    "m/s": "outside the physical range of speeds",
    "m": "outside the physical range: gaps below it are side by side or errors of position and "
    "length, gaps above it no longer concern the ego",
    "lateral_offset": "bodies that overlap across (errors of lane position, or an ego far from its "
    "lane's centre), or more than one lane apart",
}


@dataclass(frozen=True)
class Candidate:
    """One number of components that was tried."""

    components: int
    bic: float
    smallest: float
    """Events in the smallest component (sum of its responsibilities)."""
    accepted: bool
    """False if a component has collapsed on a handful of events."""


@dataclass(frozen=True)
class Fit:
    """A fitted base distribution and how it was chosen."""

    mixture: TruncatedGaussianMixture
    candidates: tuple[Candidate, ...]


def read_events(path: Path, recipe: Recipe) -> dict[str, NDArray[Any]]:
    """Columns of an events file, numbers as float64 with NaN where a value is missing.

    Raises:
        ValueError: The file cannot be read or lacks a column.
    """
    try:
        table = csv.read_csv(path)
    except (OSError, ArrowInvalid) as error:
        raise ValueError(f"Cannot read events from {path}: {error}.") from None
    wanted = (*recipe.columns, *recipe.required, *(("phase",) if recipe.phase else ()))
    missing = [name for name in wanted if name not in table.column_names]
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}.")
    numbers = {name: table[name].cast("float64").to_numpy() for name in recipe.columns}
    return numbers | {name: table[name].to_numpy() for name in wanted[len(recipe.columns) :]}


def filter_events(
    events: Mapping[str, NDArray[Any]], recipe: Recipe, box: Sequence[Parameter]
) -> tuple[tuple[Array, Array], list[dict[str, Any]]]:
    """Usable events and what each filter dropped.

    Returns:
        Events of the joint columns, shape (n, d - a), and of the a columns apart, shape (m, a); and per filter its
        rule, its reason and the number of events it dropped of those that passed the filters before. The filters
        of the columns apart come last, and say so.
    """
    keep = np.ones(len(events[recipe.columns[0]]), dtype=bool)
    if recipe.phase is not None:
        keep &= events["phase"] == recipe.phase
    log: list[dict[str, Any]] = [{"rule": "events read", "events": int(keep.sum())}]

    def apply(rule: str, reason: str, passes: Mask) -> None:
        dropped = int((keep & ~passes).sum())
        log.append({"rule": rule, "reason": reason, "dropped": dropped})
        np.logical_and(keep, passes, out=keep)

    def apply_range(column: str, p: Parameter) -> None:
        inside = (events[column] >= p.low) & (events[column] <= p.high)
        reason = REASONS.get(p.name, REASONS[p.unit])
        apply(f"{p.low:g} <= {column} <= {p.high:g} {p.unit}", reason, inside)

    joint = recipe.columns[: len(recipe.columns) - len(recipe.apart)]
    for column in recipe.columns:
        apply(f"{column} is given", REASONS["missing"], ~np.isnan(events[column]))
    for column, p in zip(joint, box, strict=False):
        apply_range(column, p)
    log.append({"rule": "events used", "columns": list(joint), "events": int(keep.sum())})
    together = np.column_stack([events[column][keep] for column in joint])
    for column in recipe.required:
        apply(column, REASONS[column], events[column].astype(bool))
    for column, p in zip(recipe.apart, box[len(joint) :], strict=True):
        apply_range(column, p)
    if recipe.apart:
        log.append({"rule": "events used", "columns": list(recipe.apart), "events": int(keep.sum())})
    own = np.empty((int(keep.sum()), len(recipe.apart)))
    for j, column in enumerate(recipe.apart):
        own[:, j] = events[column][keep]
    return (together, own), log


def beside(joint: TruncatedGaussianMixture, apart: TruncatedGaussianMixture) -> TruncatedGaussianMixture:
    """The law of independent points side by side: a mixture, and behind it one of a single component."""
    d, k = joint.dim + apart.dim, len(joint.weights)
    covariances = np.zeros((k, d, d))
    covariances[:, : joint.dim, : joint.dim] = joint.covariances
    covariances[:, joint.dim :, joint.dim :] = apart.covariances
    means = np.hstack([joint.means, np.repeat(apart.means, k, axis=0)])
    low, high = np.append(joint.low, apart.low), np.append(joint.high, apart.high)
    return TruncatedGaussianMixture(joint.weights, means, covariances, low, high)


def fit_mixture(points: Array, low: Array, high: Array, seed: int = 0, most: int = MAX_COMPONENTS) -> Fit:
    """Gaussian mixture chosen by BIC, cut to a box.

    For K = 1, 2, ... while there are `EVENTS_PER_COMPONENT` d events per component: expectation
    maximisation on standardised data from `RESTARTS` seeded starts, with a floor under the
    covariances. Fits with a component of fewer than `SMALLEST_COMPONENT` d events are rejected.

    Args:
        points: Events, shape (n, d), with n > d.
        low: Lower ends of the box, shape (d,).
        high: Upper ends of the box, shape (d,).
        seed: Of the starts; same seed, same fit.
        most: Largest number of components to try.

    Raises:
        ValueError: There are no more events than parameters, or one of them does not vary.
    """
    n, d = points.shape
    if n <= d:
        raise ValueError(f"{n} events are too few to fit {d} parameters; more than {d} are needed.")
    centre, scale = points.mean(axis=0), points.std(axis=0)
    if (scale == 0).any():
        raise ValueError(f"Parameter {int(np.argmin(scale))} is the same in all {n} events.")
    standard = (points - centre) / scale
    most = int(np.clip(n // (EVENTS_PER_COMPONENT * d), 1, most))
    models = [_expectation_maximisation(standard, k, seed) for k in range(1, most + 1)]
    candidates = tuple(_assess(model, standard) for model in models)
    accepted = [i for i, candidate in enumerate(candidates) if candidate.accepted]
    best = models[min(accepted, key=lambda i: candidates[i].bic)]
    covariances = best.covariances_ * np.outer(scale, scale)
    mixture = _rounded(best.weights_, centre + best.means_ * scale, covariances, low, high)
    return Fit(mixture, candidates)


def _expectation_maximisation(standard: Array, components: int, seed: int) -> Any:
    model = GaussianMixture(
        components,
        covariance_type="full",
        tol=1e-6,
        reg_covar=COVARIANCE_FLOOR,
        max_iter=5000,
        n_init=RESTARTS,
        random_state=seed,
    )
    return model.fit(standard)


def _assess(model: Any, standard: Array) -> Candidate:
    n, d = standard.shape
    smallest = float(model.weights_.min() * n)
    accepted = model.n_components == 1 or smallest >= SMALLEST_COMPONENT * d
    return Candidate(model.n_components, float(model.bic(standard)), smallest, accepted)


def _rounded(weights: Array, means: Array, covariances: Array, low: Array, high: Array) -> TruncatedGaussianMixture:
    """The mixture to six significant digits, heaviest component first.

    More digits would say nothing about the traffic and differ between machines.
    """
    order = np.argsort(-weights)
    shares = np.round(weights[order], 6)
    shares[0] = 1.0 - shares[1:].sum()
    symmetric = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    return TruncatedGaussianMixture(shares, _significant(means[order]), _significant(symmetric[order]), low, high)


def _significant(values: Array) -> Array:
    rounded = np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[np.float64])(values)
    return np.asarray(rounded, dtype=np.float64)


def mass_outside(mixture: TruncatedGaussianMixture, seed: int = 0) -> dict[str, Any]:
    """How much of the untruncated mixture the box cuts away.

    Returns:
        `any`: probability that some coordinate is outside, with its `standard_error` (Monte Carlo);
        `each`: the same per coordinate, from the marginals.
    """
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(MASS_SAMPLES, mixture.weights)
    outside = 0
    for n, mean, covariance in zip(counts, mixture.means, mixture.covariances, strict=True):
        x = mean + rng.standard_normal((n, mixture.dim)) @ np.linalg.cholesky(covariance).T
        outside += int(((x < mixture.low) | (x > mixture.high)).any(axis=1).sum())
    p = outside / MASS_SAMPLES
    scale = np.sqrt(np.diagonal(mixture.covariances, axis1=1, axis2=2))
    below = ndtr((mixture.low - mixture.means) / scale)
    above = ndtr((mixture.means - mixture.high) / scale)
    each = mixture.weights @ (below + above)
    return {
        "any": p,
        "standard_error": float(f"{np.sqrt(p * (1.0 - p) / MASS_SAMPLES):.2g}"),
        "each": [float(f"{value:.3g}") for value in each],
    }


def base_file(
    scenario: str,
    mixture: TruncatedGaussianMixture,
    provenance: Mapping[str, Any],
    replaced: Mapping[str, Any] = MappingProxyType({}),
) -> str:
    """Text of a base distribution file, as `rare_envs.bases.load_base` reads it.

    Args:
        scenario: Name of the scenario, such as "cut_in".
        mixture: The law, of logarithms where some coordinates are.
        provenance: Where it comes from.
        replaced: Entries in place of the mixture's own: the box of x, where some coordinates are logarithms.
    """
    content = {
        "names": [p.name for p in named(scenario).parameters],
        "units": [p.unit for p in named(scenario).parameters],
        **mixture.to_dict(),
        **replaced,
        "provenance": {**provenance, "mass_outside_box": mass_outside(mixture)},
    }
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def us101_base(scenario: str, data: Path, seed: int = 0) -> str:
    """Fits one scenario to the US 101 events and returns the text of its file."""
    return fitted_base(scenario, data / RECIPES[scenario].file, SOURCE, COMMAND, seed)


def fitted_base(scenario: str, path: Path, source: Mapping[str, str], command: str, seed: int = 0) -> str:
    """Fits one scenario to a file of events and returns the text of its file.

    Args:
        scenario: A key of `RECIPES`.
        path: CSV with the columns of the recipe.
        source: Where the events come from, and under which licence.
        command: What writes the file.
        seed: Of the fits.

    Raises:
        ValueError: The events cannot be read, or are too few.
    """
    recipe, box = RECIPES[scenario], named(scenario).parameters
    (together, own), log = filter_events(read_events(path, recipe), recipe, box)
    low, high = (np.array([getattr(p, end) for p in box]) for end in ("low", "high"))
    chosen = np.array([column in recipe.logarithmic for column in recipe.columns])
    joint = together.shape[1]
    together[:, chosen[:joint]] = np.log(together[:, chosen[:joint]])
    bottom, top = (np.where(chosen, np.log(np.where(chosen, end, 1.0)), end) for end in (low, high))
    try:
        fit = fit_mixture(together, bottom[:joint], top[:joint], seed)
        mixture = fit.mixture
        if recipe.apart:
            own_fit = fit_mixture(own, bottom[joint:], top[joint:], seed, most=1)
            mixture = beside(mixture, own_fit.mixture)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    box_of_x = {"low": low.tolist(), "high": high.tolist(), "logarithmic": chosen.tolist()} if chosen.any() else {}
    origin = {"source": source, "file": path.name, "command": command}
    return base_file(scenario, mixture, _provenance(recipe, log, fit, seed, origin), box_of_x)


def _provenance(recipe: Recipe, log: Sequence[Any], fit: Fit, seed: int, origin: Mapping[str, Any]) -> dict[str, Any]:
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
            "restarts": RESTARTS,
            "events_per_component_and_dimension": EVENTS_PER_COMPONENT,
            "smallest_component_per_dimension": SMALLEST_COMPONENT,
            "seed": seed,
        },
        "command": origin["command"],
        "libraries": {name: version(name) for name in ("numpy", "scipy", "scikit-learn")},
    }


def own_bases(tables: Iterable[Trajectories], scenarios: Sequence[str], out: Path, name: str, seed: int = 0) -> None:
    """Extracts the events of recordings and fits scenarios to them.

    Writes `<scenario>_events.csv` and `<scenario>_<name>.json` into a folder; `load_base` reads the latter.

    Raises:
        ValueError: A recording is broken, or the events of a scenario are too few; their file is written all the same.
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
        "changes": SOURCE["changes"],
    }
    files = {scenario: out / f"{scenario}_events.csv" for scenario in scenarios}
    for scenario, path in files.items():
        write_events(pooled([events[scenario] for events in parts]), path)
        typer.echo(path)
    for scenario, path in files.items():
        base = out / f"{scenario}_{name}.json"
        base.write_text(fitted_base(scenario, path, source, OWN_COMMAND, seed), encoding="utf-8")
        typer.echo(base)


def main(
    out: Annotated[Path, typer.Option(help="Folder for the JSON files.")],
    data: Annotated[Path | None, typer.Option(help="Folder with the US 101 events files.")] = None,
    highd: Annotated[Path | None, typer.Option(help="Data folder of highD.")] = None,
    ngsim: Annotated[Path | None, typer.Option(help="A raw NGSIM file.")] = None,
    location: Annotated[str | None, typer.Option(help="Location, where an NGSIM file has several.")] = None,
    cut_gaps: Annotated[bool, typer.Option("--cut-gaps", help="Cut tracks where frames are missing.")] = False,
    scenario: Annotated[list[str] | None, typer.Option(help="Of your own recordings: which to fit.")] = None,
    name: Annotated[str, typer.Option(help="Name of the bases of your own recordings.")] = "own",
    seed: Annotated[int, typer.Option(help="Seed of the fits.", min=0)] = 0,
) -> None:
    """Writes base distributions: us101 (fitted) and highway (assembled), or those of your own recordings."""
    try:
        if sum(source is not None for source in (data, highd, ngsim)) != 1:
            raise ValueError("Give one of --data, --highd and --ngsim.")
        chosen = tuple(scenario or RECIPES)
        if unknown := sorted(set(chosen) - set(RECIPES)):
            raise ValueError(f"Unknown scenario {unknown[0]}; known are {', '.join(RECIPES)}.")
        gaps: Gaps = "cut" if cut_gaps else "error"
        if highd is not None:
            tables = (load_highd(highd, recording, gaps=gaps) for recording in highd_recordings(highd))
            own_bases(tables, chosen, out, name, seed)
        elif ngsim is not None:
            own_bases([load_ngsim(ngsim, location=location, gaps=gaps)], chosen, out, name, seed)
        elif data is not None:
            _package_bases(data, out, seed)
    except (OSError, ValueError) as error:
        typer.echo(f"Error: {error}", err=True)
        raise typer.Exit(2) from None


def _package_bases(data: Path, out: Path, seed: int) -> None:
    texts = {}
    for scenario in RECIPES:
        texts[f"{scenario}_us101.json"] = us101_base(scenario, data, seed)
        texts[f"{scenario}_highway.json"] = base_file(scenario, *highway_base(scenario))
    out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
        typer.echo(out / name)


if __name__ == "__main__":
    typer.run(main)
