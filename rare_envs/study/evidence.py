"""Evidence: what a safety engineer files about a run, made from its folder alone.

It has what was covered, how uncertain the number is and from what, checks of the tool chain, test cases, and a claim
tree, `claims`. Nothing here assesses conformity with a regulation or a standard.

References:
    ISO 34502:2022, traffic disturbance scenarios; ISO 34505:2025, test cases.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib import resources
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from scipy.stats import poisson

from rare_envs.files import format_json, read_json, replace_text
from rare_envs.scenarios.registry import env_id_of, find_scenario
from rare_envs.simulation.terms import EpisodeTerms
from rare_envs.startup import __version__
from rare_envs.study import claims, episodes
from rare_envs.study.arguments import BadInput, as_bad_input, output_folder
from rare_envs.study.evaluate import run
from rare_envs.study.export import export_drive
from rare_envs.study.html_report import render
from rare_envs.study.question import Study, open_run, prepare
from rare_envs.study.replay import REPLAY_TOLERANCE, Drive, drive_again, read_row
from rare_envs.study.report import Repeatability, Report
from rare_envs.study.risk import Risk, ScenarioRisk
from rare_envs.study.run_folder import COMPARISON, EVIDENCE, RESULT, RISK, STUDY, LoadedStudy, load_finished
from rare_envs.study.text import describe_kind, name_scenario, report_as_json
from rare_envs.study.writing import remove_evidence
from samplers.evaluate import find_changed as find_differing
from samplers.output import to_json_value
from samplers.problem import EvaluationError, FloatArray

Files = dict[str, dict[str, Any]]
Known = claims.Digests
PICTURE, PAGE, SCHEMA_FILE = "claims.svg", "evidence.html", "evidence.schema.json"
SCHEMA: dict[str, Any] = json.loads((resources.files("rare_envs") / "data/evidence_schema.json").read_text("utf-8"))
"""JSON schema of all files of the evidence together, {name: content}; of a run, or of a risk."""
N_COMPARED, MOST_CASES = 1_000, 20
"""Ordinary scenarios that both simulators drive, and test cases at most."""
EQUAL = 1e-9
"""Largest relative difference of a number that is computed again."""
MADE_BY = ("command", "begun", "finished", "seed", "ego", "base", "versions", "files")
"""What made a run and makes it again."""
NOT_COMPUTED = ("seconds", "earlier_seconds", "n_retried", "faults", "question", "version")
"""What a result has beside what follows from its simulations."""
FACTOR = "Its contacts are {:.2g} times the nearest end of people's interval (1: inside); nothing was multiplied by it."
"""How the human driver model compares with people."""
AGAIN = f"{RESULT} computed again by the method from the simulations recorded; terms of method series simulated again"
SUM_AGAIN = f"{RISK} computed again from its runs; the spread between sites is taken as recorded"
"""What is computed again."""
CHECK_TAIL = 0.025
"""A recorded count is outside what the traffic model expects if a count as extreme has a smaller probability."""
MOTIONS = ("cut-in", "cut-out", "acceleration", "deceleration")
SECTORS, EGOS = ("main roadway", "merging zone", "departure zone"), ("lane keep", "lane change")
CELLS = tuple(map(", ".join, product(SECTORS, EGOS, MOTIONS)))
"""The 24 traffic disturbance scenarios of ISO 34502: road sector, behaviour of the ego, motion of another vehicle."""
# in car-following the lead keeps its speed, which is no disturbance of the list
_COVERED = {"cut_in": MOTIONS[:1], "hard_brake": MOTIONS[3:], "highway": MOTIONS}
NOT_COVERED = (
    "perception disturbances (blind spots, sensor limits, weather), unless the ego's own sensors have them",
    "vehicle control disturbances (road surface, wind, vehicle faults)",
    "pedestrians, cyclists, crossings, traffic lights, works and emergency vehicles",
)


def write_evidence(folder: Path, trust: bool = False) -> tuple[Path, ...]:
    """Write the evidence of a finished run into its folder; of a risk, that of each run and that of the sum.

    Args:
        folder: Of `rare-envs estimate --out` or `rare-envs risk --out`.
        trust: Whether code that a folder from elsewhere names may run.

    Returns:
        The files written, in place of earlier ones, the page of each run before its others, those of a sum last.

    Raises:
        BadInput: There is no finished run, it may not be driven again, or a file cannot be written.
    """
    if (folder / COMPARISON).is_file():
        raise BadInput(
            f"Expected the folder of rare-envs estimate or risk, got that of a comparison, {str(folder)!r}, whose runs "
            "keep no simulations: evidence is of one ego, from its own rare-envs risk EGO --out FOLDER."
        )
    known: Known = {}
    if not (folder / RISK).is_file():
        return _write_evidence_of_run(folder, trust, known)[1]
    with as_bad_input(OSError, ValueError):
        runs, recorded = claims.list_runs(folder), read_json(folder / RISK)
        filed = claims.find_changed(folder, known=known) if (folder / EVIDENCE / claims.MANIFEST).is_file() else []
    found = {part.name: _write_evidence_of_run(part, trust, known) for part in runs}
    reports, out = {name: report for name, (report, _) in found.items()}, folder / EVIDENCE
    with output_folder(out, PAGE, *claims.FILES), as_bad_input(OSError, ValueError, KeyError, TypeError):
        remove_evidence(folder)
        content = describe_sum(folder, recorded, reports, filed)
        title = f"{recorded['ego']} in {' and '.join(map(name_scenario, reports))}"
        own = _finish(folder, title, content, claims.build_claims_of_sum(recorded), recorded["text"], known)
    return (*chain(*(files for _, files in found.values())), *own)


def _write_evidence_of_run(folder: Path, trust: bool, known: Known) -> tuple[Report | str, tuple[Path, ...]]:
    """Write the evidence of one run; return its report, or why that cannot be computed again, and the files."""
    study = load_finished(folder)
    prepared = prepare(open_run(study, trust))
    out = folder / EVIDENCE
    with output_folder(out, PAGE, *claims.FILES, folders=("test_cases",)), as_bad_input(OSError, ValueError):
        filed = claims.find_changed(folder, known=known) if (out / claims.MANIFEST).is_file() else []
        remove_evidence(folder)
        rows, report = list_failures(study), compute_again(study, prepared)
        drives = [drive_again(prepared.problem, read_row(study.failures, prepared.problem, row)) for row in rows]
        content: Files = {
            claims.COVERAGE: describe_coverage(prepared),
            claims.UNCERTAINTY: list_uncertainty(study.result),
            claims.VALIDATION: validate(study, prepared, drives, report, filed),
            claims.TRAFFIC: describe_traffic_model(prepared),
            claims.TEST_CASES: write_test_cases(out, study, prepared, rows, drives),
            claims.ORIGIN: {name: study.about.get(name) for name in MADE_BY},
        }
        title, answer = f"{study.question['ego']} in {study.question['env_id']}", study.result.get("text") or []
        return report, _finish(folder, title, content, claims.build_claims(study.result), answer, known)


def _finish(
    folder: Path, title: str, content: Files, nodes: Sequence[Mapping[str, Any]], answer: Sequence[str], known: Known
) -> tuple[Path, ...]:
    """Write the files of the evidence in a folder, its claims, judged by them, and its page; return all, this first."""
    out = folder / EVIDENCE
    for name, value in content.items():
        replace_text(out / name, format_json(to_json_value(value)))
    _seal(folder, known)
    content[claims.CLAIMS] = claims.judge_claims(folder, nodes)
    replace_text(out / claims.CLAIMS, format_json(content[claims.CLAIMS]))
    replace_text(out / PICTURE, claims.draw_claims(content[claims.CLAIMS]["nodes"]))
    replace_text(out / SCHEMA_FILE, format_json(SCHEMA))
    picture = (out / PICTURE).read_text(encoding="utf-8")
    page: dict[str, Any] = {"title": title, "answer": answer, "disclaimer": claims.DISCLAIMER}
    page["picture"] = Markup(picture[picture.index("<svg") :])  # of this program, its texts escaped
    page |= {name.removesuffix(".json"): value for name, value in content.items()}
    replace_text(out / PAGE, render("evidence.html.j2", page))
    _seal(folder, known)
    return tuple(sorted(filter(Path.is_file, out.rglob("*")), key=lambda path: (path.name != PAGE, path)))


def _seal(folder: Path, known: Known) -> None:
    """Write the manifest with the digests of all files as they are now."""
    digests = {"sha256": claims.digest_files(folder, ("",), known)}
    replace_text(folder / EVIDENCE / claims.MANIFEST, format_json(digests))


def sum_up(files: Sequence[Path]) -> tuple[list[str], str, str]:
    """Return the files found to be changed, the manifest with digests of all, and its own, to be kept elsewhere."""
    last = {path.name: path for path in files}
    changed = list(read_json(last[claims.VALIDATION])["changed"])
    return changed, str(last[claims.MANIFEST]), claims.digest_file(last[claims.MANIFEST])


class _Recorded:
    """The problem of a run, whose f are those that it has recorded."""

    def __init__(self, problem: Any, study: LoadedStudy) -> None:
        table = study.episodes([*episodes.name_columns(problem.space), "f"])
        keys, f = episodes.digest_scenarios(episodes.read_scenarios(table, problem.space)), table["f"].to_numpy()
        self._problem, self._f = problem, dict(zip(keys, f.tolist(), strict=True))
        self.n_terms, self.largest = 0, list[float]()

    def __getattr__(self, name: str) -> Any:
        """Return what the problem has."""
        return getattr(self._problem, name)

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f (n,) of scenarios x (n, d) of the run."""
        try:
            return np.array([self._f[key] for key in episodes.digest_scenarios(x)], dtype=np.float64)
        except KeyError:
            raise EvaluationError("the method asks for simulations that the run does not have") from None

    def terms(self, x: FloatArray, gamma: float = 0.0) -> EpisodeTerms:
        """Return the terms of scenarios x of the run, which are simulated again; f that differ are kept in mind."""
        f = self.evaluate(x)
        found: EpisodeTerms = self._problem.terms(x, gamma)
        changed = find_differing(found.f, f)
        self.n_terms += len(x)
        self.largest += np.nan_to_num(np.abs(found.f - f)[changed], nan=np.inf).tolist()
        return found


def compute_again(study: LoadedStudy, prepared: Study) -> Report | str:
    """Return the report that the method gives with the simulations of a run, or why there is none.

    Nothing is simulated but failures, for what they are like, and the terms of method series, whose f are compared.
    Where numbers are rounded otherwise (processor, library) a method may ask for other simulations.
    """
    if not study.episodes_path.is_file():
        return f"there is no {study.episodes_path.name}"
    if study.result.get("version") != __version__:
        return f"the run is of version {study.result.get('version')}, this is {__version__}"
    try:
        problem: Any = _Recorded(prepared.problem, study)
        report = run(replace(prepared, problem=problem, ego_was_given=True))
    except BadInput as error:
        return str(error)
    if problem.largest:
        return replace(report, repeatability=Repeatability(problem.n_terms, len(problem.largest), max(problem.largest)))
    again = study.result.get("repeatability")
    if again is not None:  # a difference that is infinite has no number
        again = Repeatability(**{**again, "largest": np.inf if again["largest"] is None else again["largest"]})
    return replace(report, repeatability=again)


def list_differences(recorded: Mapping[str, Any], again: Mapping[str, Any]) -> list[str]:
    """Return what of a recorded result is not what was computed again, by name."""
    found = json.loads(format_json(to_json_value(again)))
    known = {name: value for name, value in found.items() if name not in NOT_COMPUTED}
    return _list_apart({name: recorded.get(name) for name in known}, known)


def _list_apart(a: Any, b: Any, place: str = "") -> list[str]:
    """Return the names, such as "rate.p", of what differs between values of JSON, numbers by more than rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        pairs = {name: (a.get(name, ...), b.get(name, ...)) for name in (*b, *a)}
        return [each for name, pair in pairs.items() for each in _list_apart(*pair, f"{place}.{name}".lstrip("."))]
    if isinstance(a, list) and isinstance(b, list):
        equal = len(a) == len(b) and not any(map(_list_apart, a, b))
    else:
        equal = math.isclose(a, b, rel_tol=EQUAL) if isinstance(a, float) and isinstance(b, int | float) else a == b
    return [] if equal else [place]


def list_failures(study: LoadedStudy) -> list[int]:
    """Return the rows of failures.csv for test cases: the most likely of each mode, then the next most likely."""
    of_modes = [mode["failure"] for mode in study.result.get("modes") or [] if mode.get("failure") is not None]
    rows = dict.fromkeys([*of_modes, *range(len(study.failures["f"]))])
    return [row for row in rows if not np.isnan(study.failures["f"][row])][:MOST_CASES]  # the ego gave an answer


def describe_coverage(study: Study) -> dict[str, Any]:
    """Return the statement of what was covered: scenario categories, operational design domain, traffic."""
    question, problem = study.question, study.problem
    scenario, road = problem.world.scenario, problem.world.scenario.road
    curvature = max((abs(each) for each in road.reference_line.curvature), default=0.0) if road.reference_line else 0.0
    covered = [f"main roadway, lane keep, {motion}" for motion in _COVERED.get(scenario.name, ())]
    low, high = episodes.find_ordinary_range(episodes.draw_ordinary(problem.space))
    return {
        "statement": "Only what is listed as covered was simulated. The number says nothing about anything else.",
        "scenario": question.env_id,
        "event": scenario.name,
        "iso_34502": {"covered": covered, "not_covered": [cell for cell in CELLS if cell not in covered]},
        "also_not_covered": list(NOT_COVERED),
        "operational_design_domain": {
            "road": "motorway lanes, no junction",
            "lanes": len(road.edges) - 1,
            "lane_widths_m": [round(b - a, 3) for a, b in zip(road.edges, road.edges[1:], strict=False)],
            "least_radius_m": "straight" if curvature == 0 else round(1.0 / curvature, 1),
            "vehicles": list(scenario.labels),
            "drivers_of_others": question.drivers or scenario.drivers or "script of the scenario",
            "weather": "drawn" if question.weather else "none",
            "duration_s": problem.world.clock.horizon,
            "time_step_s": problem.world.clock.dt,
            "ego_observes": question.observation,
            "ego_acts": question.action,
        },
        "parameters": [
            {"name": column.name, "unit": column.unit, "central_90_percent": [float(low[j]), float(high[j])]}
            for j, column in enumerate(episodes.list_columns(problem.space))
            if column.shown
        ],
        "counted": f"{question.measure} <= {question.gamma:g}, collisions of {question.collisions}",
    }


def list_uncertainty(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return the uncertainty budget of p: each source with its interval or limit, and where it stands."""
    traffic, events = result.get("base_uncertainty") or {}, result.get("events") or []
    variance = (result.get("rate") or {}).get("log_variance") or {}
    known = (traffic.get("reason") or "") == "" and traffic.get("interval") is not None
    ends = traffic["interval"] if known else [0.0, traffic.get("bound")]
    few = f"few recorded events: {traffic.get('fitted_to') or 'not fitted to events'}"
    rows = (
        ("sampling", "finite number of simulations", list(result["interval"]), "/interval"),
        ("undiscovered", "a crash type that no simulation met, at most", [0.0, result.get("unseen")], "/unseen"),
        ("traffic model", few, list(ends), f"/base_uncertainty/{'interval' if known else 'bound'}"),
    )
    sources: list[dict[str, Any]] = [
        {**dict(zip(("source", "what", "interval_of_p", "pointer"), row, strict=True)), "file": RESULT} for row in rows
    ]
    upper, rate = sources[2]["interval_of_p"][1], result.get("rate") or {"determined": True}
    sources[2]["limited"] = None if upper is None else bool(upper < 1 and rate["determined"])
    total = sum(variance.values())
    calibration = [
        {
            "event": each["event"],
            "people_per_million_km": (each.get("people") or {}).get("interval_per_million_km"),
            "human_driver_model": FACTOR.format(each["calibration"]["factor"]) if each.get("calibration") else None,
            "uncalibrated": each.get("uncalibrated"),
            # a factor of nothing says nothing
            "calibrated": not each["uncalibrated"] if (each.get("people") or {}).get("count") else None,
        }
        for each in events
    ]
    unresolved, cov = _list_unresolved(result), result.get("cov")
    sure = result.get("status") == "converged" and not unresolved
    return {
        "p": result["p"],
        "confidence": result["confidence"],
        "simulations": {
            "relative_error": cov,
            "too_few_failures_in": unresolved,
            "status": result.get("status"),
            "enough": None if cov is None else bool(cov <= claims.ENOUGH_COV and sure),
        },
        "sources": sources,
        "shares_of_log_variance_of_the_rate": {name: each / total for name, each in variance.items() if total},
        "calibration": calibration,
        "rate_per_million_km": (result.get("rate") or {}).get("interval_per_million_km"),
        "left_out": "the choice of the model family, drivers' behaviour outside the recordings, rounding",
    }


def _list_unresolved(result: Mapping[str, Any]) -> list[str]:
    """Return the parts of the traffic with too few failures; that of cutters who do not look is called "unseen"."""
    names = [str(part["name"]) for part in result.get("parts") or [] if not part["resolved"]]
    return [name.replace("unseen", "no look") for name in names]


def validate(
    study: LoadedStudy, prepared: Study, drives: Sequence[Drive], again: Report | str, filed: Sequence[str]
) -> dict[str, Any]:
    """Return checks of the tool chain: failures driven and the result computed again, simulators, doubts, changes."""
    rows, result = list_failures(study), study.result
    recorded, found = study.failures["f"][rows], np.array([drive.f for drive in drives])
    differing = None if isinstance(again, str) else list_differences(result, report_as_json(again))
    few = [f"{name}: too few failures found" for name in _list_unresolved(result)]
    traffic = [f"traffic model: {text}" for text in (result.get("base_uncertainty") or {}).get("warnings") or []]
    warnings = [*(result.get("doubts") or []), *(result.get("warnings") or []), *traffic, *few]
    apart = int(np.sum(~(np.abs(found - recorded) <= REPLAY_TOLERANCE)))
    forged = [f"{RESULT} ({', '.join(differing)})"] if differing else []
    return {
        "replays": {
            "what": "failures of the run, driven again one by one with every moment kept",
            "compared": len(rows),
            "differing": apart if len(rows) else None,
            "without_answer_of_the_ego": int(np.isnan(study.failures["f"]).sum()),
            "largest_difference_of_f": float(np.abs(found - recorded).max()) if len(rows) else None,
            "tolerance": REPLAY_TOLERANCE,
        },
        "simulators": compare_simulators(prepared, [read_row(study.failures, prepared.problem, row) for row in rows]),
        "computed_again": {"what": AGAIN, "differing": differing, "reason": again if isinstance(again, str) else ""},
        "warnings": list(dict.fromkeys(warnings)),
        "files_changed": study.changed_files if study.about.get("results") else None,
        "changed": list(dict.fromkeys([*study.changed_files, *forged, *filed])),
    }


def compare_simulators(study: Study, failures: Sequence[FloatArray]) -> dict[str, Any]:
    """Return how far the compiled simulator and the one of torch agree, in failures and in ordinary scenarios."""
    about: dict[str, Any] = {"what": "failures and ordinary scenarios by the compiled simulator and by torch"}
    about |= {"compared": 0, "failures_differing": None, "reason": ""}
    if study.problem.varies:
        return about | {"reason": "the ego's answers vary"}
    if study.problem.core != "numba":
        return about | {"reason": "this question is simulated by torch alone"}
    x = study.problem.space.sample(N_COMPARED, np.random.default_rng(study.question.seed))
    x = np.vstack([x, *failures])
    other = prepare(replace(study.question, core="torch", device="cpu"), study.problem.ego).problem
    compiled, reference = study.problem.evaluate(x), other.evaluate(x)
    fail = [f <= study.question.gamma for f in (compiled, reference)]
    either, differing = int(np.sum(fail[0] | fail[1])), int(np.sum(fail[0] != fail[1]))
    about |= {"compared": len(x), "failing_in_either": either, "failures_differing": differing if either else None}
    return about | {"largest_difference_of_f": float(np.abs(compiled - reference).max())}


def describe_traffic_model(study: Study) -> dict[str, Any]:
    """Return where the traffic model comes from, and recorded counts of dangerous states beside expected ones."""
    fitted = study.fitted
    if fitted is None:
        return {"name": study.base_name, "kind": "not fitted to recorded events", "checks": [], "checks_outside": None}
    checks = []
    for check in fitted.checks:
        tails = poisson.cdf(check.recorded, check.expected), poisson.sf(check.recorded - 1, check.expected)
        checks.append({**asdict(check), "outside": bool(min(tails) < CHECK_TAIL)})
    return {
        "name": study.base_name,
        "kind": "fitted to recorded events",
        "family": fitted.family,
        "recordings": fitted.fitted_to,
        "refits": len(fitted.refits),
        "frequency": fitted.frequency and asdict(fitted.frequency),
        "checks": checks,
        "checks_outside": sum(check["outside"] for check in checks) if checks else None,
        "provenance": dict(fitted.record),
    }


def write_test_cases(
    out: Path, study: LoadedStudy, prepared: Study, rows: Sequence[int], drives: Sequence[Drive]
) -> dict[str, Any]:
    """Write a test case for each failure, with its OpenSCENARIO files, and return all of them."""
    shares = {mode.get("failure"): mode.get("of_failures") for mode in study.result.get("modes") or []}
    cases = [
        _write_case(out / "test_cases" / f"{number:02d}.xosc", study, prepared, row, drive)
        | {"share_of_p": shares.get(row)}
        for number, (row, drive) in enumerate(zip(rows, drives, strict=True))
    ]
    return {
        "about": "fields after ISO 34505: objective, scenario, initial conditions, expected and actual result; the ego "
        "of NN.xosc is free, for the system under test, the others move as they did; in NN_recorded.xosc it does too",
        "cases": cases,
        "modes_without_case": sum(row not in rows for row in shares) if shares else None,
    }


def _write_case(place: Path, study: LoadedStudy, prepared: Study, row: int, drive: Drive) -> dict[str, Any]:
    """Write the files of a test case and return its fields."""
    question, problem, about = prepared.question, prepared.problem, {"f": repr(drive.f)}
    x, space = read_row(study.failures, problem, row), problem.space
    files = export_drive(drive_again(problem, x, beyond=True), place, ego="free", properties=about)
    files += export_drive(drive, place.with_stem(f"{place.stem}_recorded"), properties=about)
    crash = study.failures["crash"][row] if "crash" in study.failures else ""
    return {
        "id": f"{Path(study.folder).resolve().name}-{place.stem}",
        "objective": f"The ego passes this scenario without {question.measure} <= {question.gamma:g}.",
        "scenario_category": problem.world.scenario.name,
        "test_environment": {"simulator": study.about.get("versions"), "scenario": question.env_id},
        "parameters": {key: value for key, value in space.named(x).items() if np.size(value) == 1},
        "units": dict(zip(space.names, space.units, strict=True)),
        "initial_conditions": {
            "vehicles": list(drive.names),
            "position_m": drive.position[0].tolist(),
            "speed_m_s": drive.speed[0].tolist(),
            "heading_rad": drive.heading[0].tolist(),
        },
        "expected_result": f"{question.measure} > {question.gamma:g} up to the end of the scenario",
        "actual_result": {"f": drive.f, "ends_after_s": float(drive.time[-1]), "kind": describe_kind(str(crash))},
        "log_density": float(study.failures["log_p0"][row]),
        "failure": row,
        "files": [str(path.relative_to(place.parents[1])) for path in files],
    }


def describe_sum(
    folder: Path, recorded: Mapping[str, Any], reports: Mapping[str, Report | str], filed: Sequence[str]
) -> Files:
    """Return the files of the evidence of a risk by name, from risk.json, and the evidence and reports of its runs."""
    parts = [folder / name / EVIDENCE for name in reports]
    coverage, uncertainty, validation, origin = (
        {part.parent.name: read_json(part / key) for part in parts}
        for key in (claims.COVERAGE, claims.UNCERTAINTY, claims.VALIDATION, claims.ORIGIN)
    )
    cells = [cell for each in coverage.values() for cell in each["iso_34502"]["covered"]]
    dropped = find_dropped(folder, recorded)
    left_out = {**recorded["left_out"], **dropped}
    differing, reason = add_again(recorded, reports, left_out)
    names = differing or ["left_out"][: len(dropped)]
    forged = [f"{RISK} ({', '.join(names)})"] if names else []
    changed = [f"{name}/{file}" for name, each in validation.items() for file in each["changed"]]
    whole = recorded["per_million_km"]
    rates = [
        {
            "scenario": name,
            **{key: each[key] for key in ("per_million_km", "interval_per_million_km")},
            "share_of_sum": each["per_million_km"] / whole if whole else None,
            "limited": uncertainty[name]["sources"][2]["limited"],
            "file": RISK,
            "pointer": f"/scenarios/{name}/interval_per_million_km",
        }
        for name, each in recorded["scenarios"].items()
    ]
    limited, first = [rate["limited"] for rate in rates], next(iter(reports))
    return {
        claims.COVERAGE: {
            **{key: coverage[first][key] for key in ("statement", "also_not_covered", "counted")},
            "scenarios": {name: f"{name}/{EVIDENCE}/{claims.COVERAGE}" for name in reports},
            "iso_34502": {"covered": cells, "not_covered": [cell for cell in CELLS if cell not in cells]},
            "left_out": left_out,
        },
        claims.UNCERTAINTY: {
            **{key: recorded[key] for key in ("per_million_km", "interval_per_million_km", "confidence")},
            "rates": rates,
            "limited": None if None in limited else all(limited),
            "shares_of_variance": recorded["shares_of_variance"],
            "calibration": [one for each in uncertainty.values() for one in each["calibration"]],
            "left_out": uncertainty[first]["left_out"],
        },
        claims.VALIDATION: {
            "computed_again": {"what": SUM_AGAIN, "differing": differing, "reason": reason},
            "warnings": recorded["warnings"],
            "changed": list(dict.fromkeys([*forged, *changed, *filed])),
        },
        claims.ORIGIN: {**origin[first], "base": {name: each["base"] for name, each in origin.items()}},
    }


def find_dropped(folder: Path, recorded: Mapping[str, Any]) -> dict[str, str]:
    """Return scenarios that risk.json does not name, by name: their runs lie there, or its runs say they were asked."""
    runs = [path.parent.name for path in folder.glob(f"*/{STUDY}")]
    asked = [read_json(folder / run / STUDY).get("scenarios") or () for run in recorded["scenarios"]]
    # code that a folder names is not imported for its name
    names = {*runs, *(find_scenario(env_id_of(str(name).rpartition(":")[2])).name for name in chain(*asked))}
    missing = sorted(names - {*recorded["scenarios"], *recorded["left_out"]})
    return dict.fromkeys(missing, f"it is in the folder, or was asked for, and {RISK} does not have it")


def add_again(
    recorded: Mapping[str, Any], reports: Mapping[str, Report | str], left_out: Mapping[str, str]
) -> tuple[list[str] | None, str]:
    """Return what of risk.json is not the sum of the reports of its runs, by name; or None, and why it is not known.

    The spread between sites is taken as recorded; `left_out` are all scenarios that were asked for and are not in it.
    """
    done, kept = list[ScenarioRisk](), {name: dict(part) for name, part in recorded["scenarios"].items()}
    for name, report in reports.items():
        if isinstance(report, str) or report.rate is None:
            return None, f"{name_scenario(name)}: {report if isinstance(report, str) else report.no_rate}"
        rate = replace(report.rate, site_log_sd=kept[name]["site_log_sd"])
        done.append(ScenarioRisk(report=report, rate=rate, site_factors=kept[name]["site_factors"]))
    again = Risk(ego=recorded["ego"], scenarios=tuple(done), left_out=left_out).to_dict()
    for part in (*kept.values(), *again["scenarios"].values()):
        part.pop("report", None)  # which its own evidence compares
    return list_differences({**recorded, "scenarios": kept}, again), ""
