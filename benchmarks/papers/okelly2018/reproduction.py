"""Reproduction of O'Kelly et al. 2018: rollouts made, summed up, record and figures written."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.stats.contingency import relative_risk

from benchmarks.papers.okelly2018.findings import compare_behaviour, compare_starts, measure_behaviour
from benchmarks.papers.okelly2018.study import (
    CORE_SPEEDS,
    EGO_NAMES,
    PRINTED_SEARCH,
    SEARCHES,
    STUDY_SCALES,
    ChunkJob,
    HighwayStudy,
    MeasuredHighway,
    RolloutFolder,
    SearchRun,
    choose_sampler,
    describe_sampler,
    draw_chunk,
    find_log_ratios,
    join_outcomes,
    measure_highway,
)
from benchmarks.papers.okelly2018.tables import (
    describe_figures,
    describe_printed,
    list_thresholds,
    make_figures,
    make_tables,
)
from benchmarks.papers.record import Entry, check_folder, make_record, write_record
from samplers.problem import FloatArray
from samplers.sample import clopper_pearson, effective_sample_size

SOURCE = (
    "O'Kelly, Sinha, Namkoong, Duchi and Tedrake, Scalable end-to-end autonomous vehicle testing via rare-event "
    "simulation, NeurIPS 2018: Tables 1 and 2, Figures 2 and 3, section 4."
)


def reproduce_okelly2018(rollouts: RolloutFolder, command: str) -> dict[str, Any]:
    """Make the rollouts that a folder lacks, write record and figures; BadInput if it has some of something else."""
    study, out = rollouts.study, rollouts.folder
    check_folder(out, study.identity)
    found = summarise_highway(study, rollouts.problem, measure_highway(rollouts))
    record = make_okelly_record(study, command, found)
    write_record(out, record, make_figures(record))
    return record


def make_okelly_record(study: HighwayStudy, command: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of a study."""
    details = {name: value for name, value in found.items() if name != "findings"}
    return make_record(
        {"ego": study.ego, "scale": study.scale, "seed": study.seed, "rollouts": asdict(study.settings)},
        title=f"O'Kelly et al. 2018 with the {study.ego} ego, {study.scale} scale",
        source=SOURCE,
        command=command,
        tables=make_tables(study.ego, study.gammas, found),
        figures=describe_figures(study.ego, found),
        findings=found["findings"],
        notes=write_notes(study, found),
        runs=[{"printed": describe_printed(study.ego), **details}],
    )


def write_notes(study: HighwayStudy, found: Mapping[str, Any]) -> list[str]:
    """Return what holds for all of it, in sentences: the question, what was run, and what the rest would take."""
    ours = study.settings
    notes = [
        f"P[lidar_ttc <= gamma] on rare_envs/Highway-v0 with the ego `{EGO_NAMES[study.ego]}`: 428 dimensions, the "
        "drivers' noise one fixed sequence as in the released code, 10 s an episode. Every row is one run with "
        "one seed.",
        f"Made: {found['rollouts']:,} of {ours.rollouts - 4 * ours.own:,} rollouts of naive Monte Carlo and the "
        f"searches, and {len(found['own'])} of {4 if ours.own else 0} estimates by our default method.",
    ]
    if found["naive"]:
        events = ", ".join(str(row["events"]) for row in found["naive"])
        notes.append(
            f"The naive p rests on {events} events at the four thresholds; ratios to it are no surer than that."
        )
    made = found["rollouts"] + sum(own["n_sim"] for own in found["own"])
    if study.scale == "full" and made >= ours.rollouts:
        return notes
    speed, full = CORE_SPEEDS[study.ego], STUDY_SCALES[study.ego, "full"]
    numbers = (full.rollouts - made, full.rollouts, full.per_search, ours.rollouts)
    rest, whole, search, this = (n / speed / 3600.0 for n in numbers)
    if study.scale == "full":
        return [*notes, f"{_say_speed(speed)} the rest takes {rest:,.1f} hours; the same command goes on."]
    return [
        *notes,
        f"The full scale has {full.naive:,} naive rollouts and four searches of {full.per_search:,}, "
        f"{full.rollouts:,} with our own method. {_say_speed(speed)} that is {whole:,.1f} hours, "
        f"{search:,.1f} for each search, and {this:,.1f} for the small scale; "
        "`--scale full` goes on where it was stopped.",
    ]


def _say_speed(speed: float) -> str:
    """Return the beginning of a sentence: not the speed of this run, so that equal seeds give equal notes."""
    return f"At {speed:,.4g} rollouts a second, about what a core of an AMD EPYC makes by its processor time,"


FAILING_DRIVEN, ORDINARY_COMPARED = 256, 4000
"""Failing runs that are driven again for their behaviour, and ordinary starts that are compared."""
ORDINARY_DRIVEN = {"lidar": 512, "vision": 64}
"""Ordinary runs that are driven again, by ego: one with a camera takes 70 times as long."""
WEIGHT_COUNT = 404
FIRST = 8
"""Outcomes that a record has, so that others can see whether they get the same."""


def summarise_highway(study: HighwayStudy, problem: Any, measured: MeasuredHighway) -> dict[str, Any]:
    """Return the figures of what was measured, as plain values.

    Returns:
        naive, naive_equal: Estimates of the thresholds, and of as many draws as a final sample has; empty if none.
        searches: By name: settings, iterations made, sampler, estimates and comparisons with naive Monte Carlo.
        own: Estimates of our default method.
        findings: Tested statements.
        first: Outcomes of the first naive rollouts.
        rollouts: All of them but those of our own method.
        rollouts_per_second: Of the fastest chunk of naive Monte Carlo, wall time; None if there is none.
    """
    final, f = study.settings.final, join_outcomes(measured.naive)
    references = [estimate_naive(f, gamma) for gamma in study.gammas] if len(f) else []
    equal = [estimate_naive(f[:final], gamma) for gamma in study.gammas] if len(f) >= final else []
    searches = {name: _summarise_search(study, name, run, f) for name, run in measured.searches.items()}
    speeds = (len(each["f"]) / each["seconds"] for each in measured.naive if each["seconds"])
    return {
        "naive": references,
        "naive_equal": equal,
        "searches": searches,
        "own": [compare_own(each, references) for each in measured.own],
        "findings": _find(study, problem, measured, f) if len(f) else [],
        "rollouts": len(f) + sum(each["search"] + each["final"] for each in searches.values()),
        "first": f[:FIRST].tolist(),
        "rollouts_per_second": max(speeds, default=None),
    }


def estimate_naive(f: FloatArray, gamma: float) -> dict[str, Any]:
    """Return P[f <= gamma] from outcomes f (n,): n, events, p, standard error as in the paper, 95 % interval."""
    n, events = len(f), int(np.count_nonzero(f <= gamma))
    p, interval = events / n, clopper_pearson(events, n, 0.95)
    found = {"gamma": gamma, "n": n, "events": events, "p": p, "standard_error": math.sqrt(p * (1 - p) / n)}
    return {**found, "interval": interval, "ess": None}


def estimate_weighted(f: FloatArray, log_ratios: FloatArray, gamma: float) -> dict[str, Any]:
    """Return the same as the mean of likelihood ratio times indicator, with the effective number of events."""
    n, fails = len(f), f <= gamma
    terms = np.where(fails, np.exp(log_ratios), 0.0)
    return {
        "gamma": gamma,
        "n": n,
        "events": int(fails.sum()),
        "p": float(terms.mean()),
        "standard_error": float(terms.std()) / math.sqrt(n),
        "interval": None,
        "ess": effective_sample_size(log_ratios[fails]),
    }


def compare_with_naive(found: Mapping[str, Any], reference: Mapping[str, Any], search: int) -> dict[str, Any]:
    """Compare an estimate from a sampler with the longest naive one; None where that cannot be said.

    Returns:
        gamma: The threshold of both.
        events_ratio, events_interval: Rare events in as many draws, sampler over base distribution (the paper's first
            figure), and the 95 % interval of that (Katz et al., 1978).
        variance_ratio: p (1 - p) / n of naive Monte Carlo over the sample variance of the weighted mean (their second).
        all_in: Likewise with the rollouts of the search counted: at equal total cost.
        error_ratio: The same with the squared distance from the longest naive estimate beside the sample variance: what
            is left of the gain if the sampler has missed failures.
        errors_off: Distance of the two estimates in their joint standard error.
    """
    p, error = reference["p"], found["standard_error"]
    distance, variance = found["p"] - p, p * (1.0 - p)
    all_in = variance / (found["n"] + search)
    ratios = {
        "variance_ratio": (variance / found["n"], error**2),
        "all_in": (all_in, error**2),
        "error_ratio": (all_in, distance**2 + error**2),
        "errors_off": (distance, math.hypot(error, reference["standard_error"])),
    }
    risk, ends = 0.0 if reference["events"] else None, None
    if found["events"] and reference["events"]:
        relative = relative_risk(found["events"], found["n"], reference["events"], reference["n"])
        interval = relative.confidence_interval(0.95)
        risk, ends = float(relative.relative_risk), (float(interval.low), float(interval.high))
    return {
        "gamma": found["gamma"],
        "events_ratio": risk,
        "events_interval": ends,
        **{name: value / by if p > 0.0 and by > 0.0 else None for name, (value, by) in ratios.items()},
    }


def _summarise_search(study: HighwayStudy, name: str, run: SearchRun, naive: FloatArray) -> dict[str, Any]:
    """Return settings and progress of a search, and what its final sample says beside naive outcomes (n,)."""
    scale, f = study.settings, join_outcomes(run.final)
    n_search = len(run.steps) * scale.draws
    found: dict[str, Any] = {
        **asdict(SEARCHES[name]),
        "iterations": len(run.steps),
        "of": scale.iterations,
        "search": n_search,
        "final": len(f),
        "steps": [{"quantile": s.quantile, "level": s.level, "elite": s.elite, "ess": s.ess} for s in run.steps],
        "estimates": [],
        "comparisons": [],
    }
    if not len(f) or not len(naive):
        return found
    jobs = run.jobs[: len(run.final)]
    draws = [draw_chunk(job.sampler, job.n, study.seed, job.key) for job in jobs]
    ratios = np.concatenate([find_log_ratios(run.base, run.chosen, x) for x in draws])
    estimates = [estimate_weighted(f, ratios, gamma) for gamma in study.gammas]
    curve = [estimate_weighted(f, ratios, gamma) for gamma in list_thresholds(study.gammas)]
    comparisons, traced = (
        [compare_with_naive(each, estimate_naive(naive, each["gamma"]), n_search) for each in group]
        for group in (estimates, curve)
    )
    return found | {
        "chosen": choose_sampler(run.steps),
        "sampler": describe_sampler(run.base, run.chosen),
        "mean_ratio": float(np.exp(ratios).mean()),  # 1 but for chance; far below, the draws lie where nothing is
        "estimates": estimates,
        "comparisons": comparisons,
        "curve": traced,
    }


def compare_own(own: dict[str, Any], references: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Add the gain over naive Monte Carlo at as many simulations, by the method's own c.o.v."""
    p = next((each["p"] for each in references if each["gamma"] == own["gamma"]), 0.0)
    error = own["p"] * own["cov"]
    gain = p * (1.0 - p) / own["n_sim"] / error**2 if p > 0.0 and 0.0 < error < float("inf") else None
    return {**own, "gain": gain}


def _find(study: HighwayStudy, problem: Any, measured: MeasuredHighway, f: FloatArray) -> list[Entry]:
    """Test what the paper says on the naive runs, and on the sampler of the search as printed."""
    fails = f <= study.gammas[-1]
    failing = _draw_rows(study, measured.naive_jobs, np.flatnonzero(fails))
    ordinary = _draw_rows(study, measured.naive_jobs, np.flatnonzero(~fails)[:ORDINARY_COMPARED])
    columns, found = problem.space.columns, list[Entry]()
    if len(failing) > 1:
        found += compare_starts(columns(failing), columns(ordinary), "failing / ordinary")
    run = measured.searches[PRINTED_SEARCH]
    if run.final:
        drawn = draw_chunk(run.chosen, ORDINARY_COMPARED, study.seed, "starts of the sampler")
        found += compare_starts(columns(drawn), columns(ordinary), "sampler of the search as printed / ordinary")
    if len(failing) > 1:
        again, usual = failing[:FAILING_DRIVEN], ordinary[: ORDINARY_DRIVEN[study.ego]]
        mixed = usual.copy()
        mixed[:, -WEIGHT_COUNT:] = again[np.arange(len(mixed)) % len(again), -WEIGHT_COUNT:]
        driven = [measure_behaviour(problem, x) for x in (again, usual, mixed)]
        found += compare_behaviour(*driven, all_failing=len(failing))
    return found


def _draw_rows(study: HighwayStudy, jobs: Sequence[ChunkJob], rows: Any) -> FloatArray:
    """Return some rows of a stage, drawn again, shape (n, d)."""
    size = study.settings.chunk
    parts = [
        draw_chunk(job.sampler, job.n, study.seed, job.key)[rows[rows // size == number] % size]
        for number, job in enumerate(jobs)
        if (rows // size == number).any()
    ]
    return np.concatenate(parts) if parts else np.empty(0)
