"""Evidence: what a safety engineer files about a run, made from its folder alone.

It has what was covered, how uncertain the number is and from what, checks of the tool chain, test cases, and a claim
tree in goal structuring notation (GSN). Each leaf of the tree names a file, a JSON pointer into it and a rule; anybody
can apply the rule to the file again (`judge_leaf`). Nothing here assesses conformity with a regulation or a standard.

References:
    ISO 34502:2022, traffic disturbance scenarios; ISO 34505:2025, test cases; GSN Community Standard, version 3, 2021;
    RFC 6901, JSON Pointer.
"""

from __future__ import annotations

import hashlib
import io
import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from scipy.stats import poisson

from rare_envs.files import digest_file, format_json, open_ordinary, parse_json_object, read_text_file, replace_text
from rare_envs.plugins import clean_text
from rare_envs.study.arguments import as_bad_input, output_folder
from rare_envs.study.episodes import draw_ordinary, find_ordinary_range, list_columns
from rare_envs.study.export import export_drive
from rare_envs.study.question import Study, open_run, prepare
from rare_envs.study.replay import REPLAY_TOLERANCE, Drive, drive_again, read_row
from rare_envs.study.run_folder import EVIDENCE, RESULT, RISK, LoadedStudy, load_finished
from rare_envs.study.text import describe_kind, format_probability, format_rate
from rare_envs.study.writing import remove_evidence
from samplers.output import to_json_value
from samplers.problem import FloatArray

__all__ = ["EVIDENCE", "SCHEMA", "Leaf", "judge_leaf", "write_evidence"]

COVERAGE, UNCERTAINTY, VALIDATION = "coverage.json", "uncertainty.json", "validation.json"
TRAFFIC, TEST_CASES, MANIFEST, CLAIMS = "traffic.json", "test_cases.json", "manifest.json", "claims.json"
FILES = (COVERAGE, UNCERTAINTY, VALIDATION, TRAFFIC, TEST_CASES, MANIFEST, CLAIMS)
PICTURE, PAGE, SCHEMA_FILE = "claims.svg", "evidence.html", "evidence.schema.json"
DISCLAIMER = (
    "This folder documents a simulation study. It is no conformity assessment and no approval, and it does not "
    "replace the judgement of a technical service."
)
_SCHEMA = resources.files("rare_envs") / "data" / "evidence_schema.json"
SCHEMA: dict[str, Any] = json.loads(_SCHEMA.read_text("utf-8"))
"""JSON schema of all files of the evidence together, {name: content}."""
N_COMPARED = 1_000
"""Ordinary scenarios that both simulators drive."""
MOST_CASES = 20
"""Test cases at most."""
ENOUGH_COV = 0.3
"""Largest relative standard error of p at which the simulations are called enough."""
SUM_TOLERANCE = 1e-6
"""Largest relative difference of p from the sum of weights, and of the rate from p times the frequency."""
FACTOR = "Its contacts are {:.2g} times the nearest end of people's interval (1: inside); nothing was multiplied by it."
"""How the human driver model compares with people."""
CHECK_TAIL = 0.025
"""A recorded count is outside what the traffic model expects if a count as extreme has a smaller probability."""

MOTIONS = ("cut-in", "cut-out", "acceleration", "deceleration")
CELLS = tuple(
    f"{road}, {ego}, {motion}"
    for road in ("main roadway", "merging zone", "departure zone")
    for ego in ("lane keep", "lane change")
    for motion in MOTIONS
)
"""The 24 traffic disturbance scenarios of ISO 34502: road sector, behaviour of the ego, motion of another vehicle."""
_COVERED: dict[str, tuple[str, ...]] = {
    "cut_in": ("cut-in",),
    "hard_brake": ("deceleration",),
    "car_following": (),  # the lead keeps its speed, which is no disturbance of the list
    "highway": MOTIONS,
}
NOT_COVERED = (
    "perception disturbances (blind spots, sensor limits, weather), unless the ego's own sensors have them",
    "vehicle control disturbances (road surface, wind, vehicle faults)",
    "pedestrians, cyclists, crossings, traffic lights, works and emergency vehicles",
)

Status = Literal["supported", "not supported", "not known"]


@dataclass(frozen=True)
class Leaf:
    """What supports a claim: a value in a file, and the rule by which it does.

    Example:
        >>> Leaf("result.json", "/doubtful", "equals", False).judge({"doubtful": True})
        'not supported'
    """

    file: str
    """File, relative to the folder of the run."""
    pointer: str
    """Place of the value in it, a JSON pointer."""
    rule: Literal["equals", "at most", "known"]
    """"equals" and "at most" compare with `limit`; "known" asks for a value at all."""
    limit: Any = None

    def judge(self, content: Mapping[str, Any]) -> Status:
        """Return whether the content of the file supports the claim."""
        value = self.read(content)
        if value in (None, ""):
            return "not known"
        right = value <= self.limit if self.rule == "at most" else self.rule == "known" or value == self.limit
        return "supported" if right else "not supported"

    def read(self, content: Mapping[str, Any]) -> Any:
        """Return the value at the pointer; None if there is none."""
        value: Any = content
        for part in filter(None, self.pointer.split("/")):
            try:
                value = value[int(part)] if isinstance(value, list) else value[part]
            except (KeyError, IndexError, ValueError, TypeError):
                return None
        return value


def judge_leaf(folder: Path, leaf: Mapping[str, Any]) -> Status:
    """Return the status of a leaf of claims.json, from its file in the folder of the run.

    A file whose digest is not that in manifest.json supports nothing; for test cases their own files count too.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no JSON object.

    Example:
        >>> judge_leaf(Path("runs/nowhere"), {"file": "result.json", "pointer": "/p", "rule": "known"})
        Traceback (most recent call last):
            ...
        FileNotFoundError: [Errno 2] No such file or directory: 'runs/nowhere/result.json'
    """
    wanted = Leaf(**{name: leaf[name] for name in ("file", "pointer", "rule", "limit") if name in leaf})
    status = wanted.judge(_read(folder / wanted.file))
    files = (wanted.file, f"{EVIDENCE}/test_cases/") if wanted.file.endswith(TEST_CASES) else (wanted.file,)
    changed = status == "supported" and any(name.startswith(files) for name in find_changed(folder))
    return "not supported" if changed else status


def find_changed(folder: Path) -> list[str]:
    """Return the result and files of the evidence, relative to a run's folder, that manifest.json has otherwise."""
    filed, found = _read(folder / EVIDENCE / MANIFEST).get("sha256") or {}, _digest_files(folder)
    return sorted(name for name in {**filed, **found} if found.get(name) != filed.get(name))


def _digest_files(folder: Path) -> dict[str, str]:
    """Return SHA-256 digests of the result of a run and of its evidence, but for the manifest that they stand in."""
    digests = {}
    for path in (folder / RESULT, *sorted((folder / EVIDENCE).rglob("*"))):
        if path.is_file() and path.name != MANIFEST:
            with open_ordinary(path) as file:
                digests[path.relative_to(folder).as_posix()] = hashlib.sha256(file.read()).hexdigest()
    return digests


def _read(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file."""
    return parse_json_object(read_text_file(path), repr(str(path)))


def write_evidence(folder: Path, trust: bool = False) -> tuple[Path, ...]:
    """Write the evidence of a finished run, or of each run of a risk, into its folder.

    Args:
        folder: Of `rare-envs estimate --out` or `rare-envs risk --out`.
        trust: Whether code that a folder from elsewhere names may run.

    Returns:
        The files written, the page of each run before its others. Those of an earlier call are replaced.

    Raises:
        BadInput: There is no finished run, it may not be driven again, or a file cannot be written.
    """
    if (folder / RISK).is_file():
        with as_bad_input(OSError, ValueError):
            names = _read(folder / RISK).get("scenarios") or ()
        return tuple(path for name in names for path in _write_evidence_of_run(folder / str(name), trust))
    return _write_evidence_of_run(folder, trust)


def _write_evidence_of_run(folder: Path, trust: bool) -> tuple[Path, ...]:
    """Write the evidence of one run and return its files."""
    study = load_finished(folder)
    prepared = prepare(open_run(study, trust))
    out = folder / EVIDENCE
    with output_folder(out, PAGE, *FILES, folders=("test_cases",)), as_bad_input(OSError, ValueError):
        filed = find_changed(folder) if (out / MANIFEST).is_file() else []
        remove_evidence(folder)
        rows = list_failures(study)
        drives = [drive_again(prepared.problem, read_row(study.failures, prepared.problem, row)) for row in rows]
        content: dict[str, dict[str, Any]] = {
            COVERAGE: describe_coverage(prepared),
            UNCERTAINTY: list_uncertainty(study.result),
            VALIDATION: validate(study, prepared, rows, drives, filed),
            TRAFFIC: describe_traffic_model(prepared),
            TEST_CASES: write_test_cases(out, study, prepared, rows, drives),
            MANIFEST: describe_origin(study),
        }
        for name, value in content.items():
            replace_text(out / name, format_json(to_json_value(value)))
        _seal(folder, content[MANIFEST])
        content[CLAIMS] = judge_claims(folder, build_claims(study.result))
        replace_text(out / CLAIMS, format_json(content[CLAIMS]))
        replace_text(out / PICTURE, draw_claims(content[CLAIMS]["nodes"]))
        replace_text(out / SCHEMA_FILE, format_json(SCHEMA))
        replace_text(out / PAGE, render(study, content, (out / PICTURE).read_text(encoding="utf-8")))
        _seal(folder, content[MANIFEST])
    cases = [out / name for case in content[TEST_CASES]["cases"] for name in case["files"]]
    return (out / PAGE, *(out / name for name in (*FILES, PICTURE, SCHEMA_FILE)), *cases)


def list_changes(files: Sequence[Path]) -> list[str]:
    """Return the files of runs, or of earlier evidence, that evidence files found to be changed."""
    return [name for path in files if path.name == VALIDATION for name in _read(path)["changed"]]


def _seal(folder: Path, origin: Mapping[str, Any]) -> None:
    """Write the manifest with the digests of the other files of the evidence as they are now."""
    replace_text(folder / EVIDENCE / MANIFEST, format_json(to_json_value({**origin, "sha256": _digest_files(folder)})))


def list_failures(study: LoadedStudy) -> list[int]:
    """Return the rows of failures.csv for test cases: the most likely of each mode, then the next most likely."""
    of_modes = [mode["failure"] for mode in study.result.get("modes") or [] if mode.get("failure") is not None]
    rows = dict.fromkeys([*of_modes, *range(len(study.failures["f"]))])
    return [row for row in rows if not np.isnan(study.failures["f"][row])][:MOST_CASES]  # the ego gave an answer


def describe_coverage(study: Study) -> dict[str, Any]:
    """Return the statement of what was covered: scenario categories, operational design domain, traffic."""
    question, problem = study.question, study.problem
    scenario = problem.world.scenario
    road = scenario.road
    curvature = max((abs(each) for each in road.reference_line.curvature), default=0.0) if road.reference_line else 0.0
    covered = [f"main roadway, lane keep, {motion}" for motion in _COVERED.get(scenario.name, ())]
    low, high = find_ordinary_range(draw_ordinary(problem.space))
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
            for j, column in enumerate(list_columns(problem.space))
            if column.shown
        ],
        "counted": f"{question.measure} <= {question.gamma:g}, collisions of {question.collisions}",
    }


def list_uncertainty(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return the uncertainty budget of p: each source with its interval or limit, and where it stands."""
    traffic, events = result.get("base_uncertainty") or {}, result.get("events") or []
    variance = (result.get("rate") or {}).get("log_variance") or {}
    known = (traffic.get("reason") or "") == "" and traffic.get("interval") is not None
    sources = [
        _source("sampling", "finite number of simulations", result["interval"], "/interval"),
        _source("undiscovered", "a crash type that no simulation met, at most", [0.0, result.get("unseen")], "/unseen"),
        _source(
            "traffic model",
            f"few recorded events: {traffic.get('fitted_to') or 'not fitted to events'}",
            traffic["interval"] if known else [0.0, traffic.get("bound")],
            "/base_uncertainty/interval" if known else "/base_uncertainty/bound",
        ),
    ]
    upper, rate = sources[2]["interval_of_p"][1], result.get("rate") or {"determined": True}
    sources[2]["limited"] = None if upper is None else bool(upper < 1 and rate["determined"])
    total = sum(variance.values())
    shares = {name: value / total for name, value in variance.items()} if total else {}
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
            "enough": None if cov is None else bool(cov <= ENOUGH_COV and sure),
        },
        "sources": sources,
        "shares_of_log_variance_of_the_rate": shares,
        "calibration": calibration,
        "rate_per_million_km": (result.get("rate") or {}).get("interval_per_million_km"),
        "left_out": "the choice of the model family, drivers' behaviour outside the recordings, rounding",
    }


def _list_unresolved(result: Mapping[str, Any]) -> list[str]:
    """Return the parts of the traffic with too few failures; that of cutters who do not look is called "unseen"."""
    names = [str(part["name"]) for part in result.get("parts") or [] if not part["resolved"]]
    return [name.replace("unseen", "no look") for name in names]


def _source(name: str, what: str, interval: Sequence[float | None], pointer: str) -> dict[str, Any]:
    """Return a row of the budget."""
    return {"source": name, "what": what, "interval_of_p": list(interval), "file": RESULT, "pointer": pointer}


def validate(
    study: LoadedStudy, prepared: Study, rows: Sequence[int], drives: Sequence[Drive], changed: Sequence[str] = ()
) -> dict[str, Any]:
    """Return checks of the tool chain: failures driven again, simulators compared, sums, doubts, files changed."""
    recorded = np.array([study.failures["f"][row] for row in rows])
    found = np.array([drive.f for drive in drives])
    sums, result = check_sums(study), study.result
    forged = [f"{RESULT} (p or the rate does not follow from {study.episodes_path.name})"] if sums["differ"] else []
    few = [f"{name}: too few failures found" for name in _list_unresolved(result)]
    traffic = [f"traffic model: {text}" for text in (result.get("base_uncertainty") or {}).get("warnings") or []]
    warnings = [*(result.get("doubts") or []), *(result.get("warnings") or []), *traffic, *few]
    differing = int(np.sum(~(np.abs(found - recorded) <= REPLAY_TOLERANCE)))
    return {
        "replays": {
            "what": "failures of the run, driven again one by one with every moment kept",
            "compared": len(rows),
            "differing": differing if len(rows) else None,
            "without_answer_of_the_ego": int(np.isnan(study.failures["f"]).sum()),
            "largest_difference_of_f": float(np.abs(found - recorded).max()) if len(rows) else None,
            "tolerance": REPLAY_TOLERANCE,
        },
        "simulators": compare_simulators(prepared, [read_row(study.failures, prepared.problem, row) for row in rows]),
        "sums": sums,
        "warnings": list(dict.fromkeys(warnings)),
        "files_changed": study.changed_files if study.about.get("results") else None,
        "changed": [*study.changed_files, *forged, *changed],
    }


def check_sums(study: LoadedStudy) -> dict[str, Any]:
    """Return the relative difference of p from the sum of weights, or of the rate from p times frequency if larger.

    None without weights, as of methods of Markov chains (ss, adss).
    """
    result, total = study.result, None
    methods = [(result.get("method") or {}).get("name"), *(part["method"] for part in result.get("parts") or [])]
    if study.episodes_path.is_file() and not {"ss", "adss"} & set(", ".join(map(str, methods)).split(", ")):
        weights = study.episodes(["log_weight"], failed=True)["log_weight"].drop_null().to_numpy()
        total = float(np.exp(weights).sum()) if len(weights) or study.p == 0 else None
    pairs = [] if total is None else [(study.p, total)]
    if rate := result.get("rate"):
        count = rate["frequency"]
        pairs.append((rate["per_million_km"], 1e6 * count["count"] / count["km"] * count["share"] * study.p))
    largest = max((abs(a - b) / max(abs(a), abs(b), 1e-300) for a, b in pairs), default=0.0)
    differ = largest > SUM_TOLERANCE
    return {"sum": total, "difference": None if total is None and not differ else largest, "differ": differ}


def compare_simulators(study: Study, failures: Sequence[FloatArray]) -> dict[str, Any]:
    """Return how far the compiled simulator and the one of torch agree, in failures and in ordinary scenarios."""
    about: dict[str, Any] = {"what": "failures and ordinary scenarios by the compiled simulator and by torch"}
    if study.problem.core != "numba" or study.problem.varies:
        reason = "the ego's answers vary" if study.problem.varies else "this question is simulated by torch alone"
        return {**about, "compared": 0, "failures_differing": None, "reason": reason}
    x = study.problem.space.sample(N_COMPARED, np.random.default_rng(study.question.seed))
    x = np.vstack([x, *failures])
    other = prepare(replace(study.question, core="torch", device="cpu"), study.problem.ego).problem
    compiled, reference = study.problem.evaluate(x), other.evaluate(x)
    fail = [f <= study.question.gamma for f in (compiled, reference)]
    either = int(np.sum(fail[0] | fail[1]))
    return {
        **about,
        "compared": len(x),
        "failing_in_either": either,
        "failures_differing": int(np.sum(fail[0] != fail[1])) if either else None,
        "largest_difference_of_f": float(np.abs(compiled - reference).max()),
        "reason": "",
    }


def describe_traffic_model(study: Study) -> dict[str, Any]:
    """Return where the traffic model comes from, and recorded counts of dangerous states beside expected ones."""
    fitted = study.fitted
    if fitted is None:
        return {"name": study.base_name, "kind": "not fitted to recorded events", "checks": [], "checks_outside": None}
    checks = []
    for check in fitted.checks:
        tails = poisson.cdf(check.recorded, check.expected), poisson.sf(check.recorded - 1, check.expected)
        checks.append({**asdict(check), "outside": bool(min(tails) < CHECK_TAIL)})
    frequency = None if fitted.frequency is None else asdict(fitted.frequency)
    return {
        "name": study.base_name,
        "kind": "fitted to recorded events",
        "family": fitted.family,
        "recordings": fitted.fitted_to,
        "refits": len(fitted.refits),
        "frequency": frequency,
        "checks": checks,
        "checks_outside": sum(check["outside"] for check in checks) if checks else None,
        "provenance": dict(fitted.record),
    }


def write_test_cases(
    out: Path, study: LoadedStudy, prepared: Study, rows: Sequence[int], drives: Sequence[Drive]
) -> dict[str, Any]:
    """Write a test case for each failure, with its OpenSCENARIO files, and return all of them."""
    modes = {mode.get("failure"): mode for mode in study.result.get("modes") or []}
    cases = [
        _write_case(out, study, prepared, number, row, drive, modes.get(row))
        for number, (row, drive) in enumerate(zip(rows, drives, strict=True))
    ]
    listed = {case["failure"] for case in cases}
    return {
        "about": "fields after ISO 34505: objective, scenario, initial conditions, expected and actual result",
        "cases": cases,
        "modes_without_case": sum(row not in listed for row in modes) if modes else None,
    }


def _write_case(
    out: Path,
    study: LoadedStudy,
    prepared: Study,
    number: int,
    row: int,
    drive: Drive,
    mode: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Write the files of a test case and return its fields."""
    question, space = prepared.question, prepared.problem.space
    name = f"{Path(study.folder).resolve().name}-{number:02d}"
    files = export_drive(drive, out / "test_cases" / f"{number:02d}.xosc", properties={"f": repr(drive.f)})
    crash = study.failures["crash"][row] if "crash" in study.failures else ""
    values = {key: value for key, value in space.named(read_row(study.failures, prepared.problem, row)).items()}
    return {
        "id": name,
        "objective": f"The ego passes this scenario without {question.measure} <= {question.gamma:g}.",
        "scenario_category": prepared.problem.world.scenario.name,
        "test_environment": {"simulator": study.about.get("versions"), "scenario": question.env_id},
        "parameters": {key: value for key, value in values.items() if np.size(value) == 1},
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
        "share_of_p": None if mode is None else mode.get("of_failures"),
        "failure": row,
        "files": [str(path.relative_to(out)) for path in files],
    }


def describe_origin(study: LoadedStudy) -> dict[str, Any]:
    """Return what made the run and how to make it again: command, seeds, versions, digests."""
    about = study.about
    names = sorted(path.name for path in study.folder.iterdir() if path.is_file())
    return {
        "command": about.get("command"),
        **{name: about.get(name) for name in ("begun", "finished", "seed", "ego", "base", "versions", "files")},
        "blake2b": {name: digest_file(study.folder / name) for name in names},
    }


def build_claims(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the nodes of the claim tree of a run, parents first."""
    gate = result.get("gate")
    evidence = f"{EVIDENCE}/"
    events = result.get("events") or []
    goals: dict[str, list[tuple[str, Leaf]]] = {
        "S1 Argue over each source of uncertainty": [
            *([("The limit is met", Leaf(RESULT, "/gate/decision", "equals", "passes"))] if gate else []),
            (
                f"Enough simulations in each part of the traffic: relative error of p at most {ENOUGH_COV:g}",
                Leaf(evidence + UNCERTAINTY, "/simulations/enough", "equals", True),
            ),
            ("Recorded events limit p", Leaf(evidence + UNCERTAINTY, "/sources/2/limited", "equals", True)),
            *[
                (
                    f"A human driver model is within a factor 3 of people's interval ({each['event']})",
                    Leaf(evidence + UNCERTAINTY, f"/calibration/{number}/calibrated", "equals", True),
                )
                for number, each in enumerate(events)
            ],
        ],
        "S2 Argue over the tool chain": [
            ("Failures replay", Leaf(evidence + VALIDATION, "/replays/differing", "equals", 0)),
            (
                "Two implementations of one model agree",
                Leaf(evidence + VALIDATION, "/simulators/failures_differing", "equals", 0),
            ),
            ("The traffic model expects what was recorded", Leaf(evidence + TRAFFIC, "/checks_outside", "equals", 0)),
            ("The run has no warning", Leaf(evidence + VALIDATION, "/warnings", "equals", [])),
        ],
        "S3 Argue over what is filed": [
            (
                "p is the sum of the weights of the failing episodes, and the rate p times their frequency",
                Leaf(evidence + VALIDATION, "/sums/difference", "at most", SUM_TOLERANCE),
            ),
            ("Each crash mode has a test case", Leaf(evidence + TEST_CASES, "/modes_without_case", "equals", 0)),
            ("The run can be made again", Leaf(evidence + MANIFEST, "/command", "known")),
            ("The files are those that the run wrote", Leaf(evidence + VALIDATION, "/files_changed", "equals", [])),
        ],
    }
    nodes: list[dict[str, Any]] = [
        {"id": "G1", "kind": "goal", "text": _describe_limit(result), "supports": None},
        {"id": "C1", "kind": "context", "text": f"Covered: {evidence}{COVERAGE}", "supports": "G1"},
        {"id": "A1", "kind": "assumption", "text": "The family of the traffic model is right", "supports": "G1"},
    ]
    for strategy, below in goals.items():
        own, _, words = strategy.partition(" ")
        nodes.append({"id": own, "kind": "strategy", "text": words, "supports": "G1"})
        for claim, leaf in below:
            number = sum(node["kind"] == "goal" for node in nodes) + 1
            nodes.append({"id": f"G{number}", "kind": "goal", "text": claim, "supports": own})
            nodes.append({"id": f"Sn{number}", "kind": "solution", "supports": f"G{number}", **_name_leaf(leaf)})
    return nodes


def _describe_limit(result: Mapping[str, Any]) -> str:
    """Return what the top claim says: the upper limit of a run, and what a gate decided of it."""
    question, rate = result["question"], result.get("rate")
    ego, env_id = question["ego"], question["env_id"]
    level = f"{100 * result['confidence']:g} %"
    high = _find_upper_limit(result)
    limit = f"Upper limit {format_probability(high)} per scenario"
    if rate is not None:
        limit = f"Upper limit {format_rate(rate['interval_per_million_km'][1])} per million km"
    if high >= 1:
        limit = "No upper limit"
    gate = result.get("gate")
    decision = "no acceptance limit was set"
    if gate:
        decision = f"limit {gate['limit']:g} {gate['quantity']}: {gate['decision']}"
    return f"{limit}; {decision} ({ego} in {env_id}, {level})"


def _name_leaf(leaf: Leaf) -> dict[str, Any]:
    """Return a leaf as JSON has it."""
    rule = leaf.rule if leaf.rule == "known" else f"{leaf.rule} {leaf.limit!r}"
    return {"text": f"{leaf.file} {leaf.pointer}: {rule}", **to_json_value(asdict(leaf))}


def _find_upper_limit(result: Mapping[str, Any]) -> float:
    """Return the widest upper limit of p that the run states, of sampling and of recorded events."""
    traffic = result.get("base_uncertainty") or {}
    ends = [result["interval"][1], (traffic.get("interval") or [0.0, 0.0])[1], traffic.get("bound")]
    return max(float(end) for end in ends if end is not None)


def judge_claims(folder: Path, nodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the tree with the status of each node: of leaves by their files, of the others by what is below them."""
    status: dict[str, str] = {}
    for node in reversed(nodes):
        below = [status[each["id"]] for each in nodes if each["supports"] == node["id"] and each["id"] in status]
        if node["kind"] == "solution":
            status[node["id"]] = judge_leaf(folder, node)
        elif below:
            worst = [each for each in ("not supported", "not known") if each in below]
            status[node["id"]] = worst[0] if worst else "supported"
    return {
        "notation": "GSN Community Standard 3",
        "disclaimer": DISCLAIMER,
        "nodes": [{**node, "status": status.get(node["id"])} for node in nodes],
    }


COLOURS = {"supported": "#dff0e2", "not supported": "#f6d9d5", "not known": "#f5ecd2", None: "#eef1f5"}
"""Fill of a node by its status."""


def draw_claims(nodes: Sequence[Mapping[str, Any]]) -> str:
    """Return the claim tree as SVG: a row for each goal with its leaf, below its strategy."""
    rows = [node for node in nodes if node["kind"] != "solution"]
    leaves = {node["supports"]: node for node in nodes if node["kind"] == "solution"}
    figure = Figure(figsize=(11.0, 0.62 * len(rows) + 0.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, 11.0), ylim=(-len(rows) + 0.2, 0.9))
    axes.axis("off")
    place: dict[str, tuple[float, float]] = {}
    for number, node in enumerate(rows):
        depth = {"G1": 0.0}.get(node["id"], 0.5 if node["kind"] != "goal" else 1.0)
        place[node["id"]] = depth + 0.1, -float(number)
        if node["supports"]:
            x, y = place[node["supports"]]
            axes.plot((x + 0.1, x + 0.1, depth + 0.1), (y - 0.25, -number, -number), color="#5b6675", linewidth=0.8)
        _draw_node(axes, node, depth + 0.1, -number, 5.4)
        if node["id"] in leaves:
            axes.plot((depth + 0.1, 6.6), (-number, -number), color="#5b6675", linewidth=0.8)
            _draw_node(axes, leaves[node["id"]], 6.6, -number, 4.2)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _draw_node(axes: Any, node: Mapping[str, Any], x: float, y: float, width: float) -> None:
    """Draw a node: a box with its id, text and status; a leaf has round ends, as in GSN."""
    style = "round4" if node["kind"] == "solution" else "square"
    below = "" if node["supports"] else "all below: "
    mark = f"{node['id']}  {node['text']}" + (f"  [{below}{node['status']}]" if node.get("status") else "")
    text = textwrap.fill(clean_text(mark), int(width * 13.5))
    axes.text(
        *(x + 0.06, y, text),
        va="center",
        fontsize=9,
        parse_math=False,
        bbox={"boxstyle": f"{style},pad=0.35", "facecolor": COLOURS[node.get("status")], "edgecolor": "#5b6675"},
    )


def render(study: LoadedStudy, content: Mapping[str, Any], picture: str) -> str:
    """Return the page."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rare_envs.study.html_report"), autoescape=True, trim_blocks=True
    )
    page = environment.get_template("evidence.html.j2").render(
        result=study.result,
        question=study.question,
        disclaimer=DISCLAIMER,
        picture=Markup(picture[picture.index("<svg") :]),  # of this program, its texts escaped
        **{name.removesuffix(".json"): value for name, value in content.items()},
    )
    return clean_text(page)
