"""Page: the report of a run, a risk or a comparison, from its folder to one HTML file."""

from __future__ import annotations

import base64
import contextlib
import io
import re
import shlex
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from rare_envs.envs.rendering import CRASH_COLOUR, ROLE_COLOURS
from rare_envs.files import replace_text
from rare_envs.people import CALIBRATED_WITHIN
from rare_envs.plugins import EgoGone, clean_text, one_line, reason_of
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.registry import find_scenario
from rare_envs.study import plots, text
from rare_envs.study.arguments import BadInput, as_bad_input, output_folder
from rare_envs.study.episodes import draw_ordinary, find_ordinary_range, format_value, list_columns
from rare_envs.study.html_report import figures as drawings
from rare_envs.study.html_report.figures import FigureOfPage
from rare_envs.study.question import open_question, open_run, prepare, split_question, warn_of_changed_files
from rare_envs.study.replay import Drive, describe_contact, drive_again, read_row
from rare_envs.study.report import explain_other_events
from rare_envs.study.run_folder import (
    COMPARISON,
    EPISODES,
    REPORT,
    RESULT,
    RISK,
    SIDES,
    STUDY,
    LoadedStudy,
    load_finished,
    read_failures,
    read_object,
)
from samplers.output import unfold_rows
from samplers.problem import FloatArray
from samplers.sample import describe_outcome
from training.fit.filters import read_csv_columns

__all__ = ["write_html_report"]

BROKEN_NUMBER = re.compile(r"(?<=\d) (?=%|× 10)|(?<=×) (?=10)")
"""Spaces within a number: "0.12 %", "3.1 × 10⁻⁵"."""
SIZED_BY_BUDGET = ("mc", "is", "two-stage", "series", "surrogate")
"""Methods whose setting n is their budget if max_sim does not say; the n of others is that of a level."""


class NearestEvent(NamedTuple):
    """The recorded event that is nearest to a failure."""

    distance: float
    """Root mean square over the parameters of their differences in standard deviations of ordinary traffic."""
    rarer: float
    """Share of ordinary scenarios that are at least as far from the event nearest to them."""
    values: FloatArray
    """Its parameters, shape (k,)."""


def read_recorded_events(path: Path, names: list[str]) -> FloatArray:
    """Read events from a CSV file with a column for each of some parameters; others are not looked at."""
    with as_bad_input(ValueError):
        columns = [np.asarray(each, dtype=np.float64) for each in read_csv_columns(path, names).values()]
    values = np.column_stack(columns)
    known: FloatArray = values[np.isfinite(values).all(axis=1)]
    if not len(known):
        raise BadInput(f"{str(path)!r} has no event with all of {', '.join(names)}.")
    return known


def find_nearest_event(x: FloatArray, events: FloatArray, ordinary: FloatArray) -> NearestEvent:
    """Return the event nearest to a failure x (k,), among events (n, k), beside ordinary scenarios (m, k)."""
    spread, root = np.maximum(ordinary.std(axis=0), 1e-12), np.sqrt(len(x))
    events = np.unique(events, axis=0)  # equal ones would all be in one leaf of the tree
    tree = KDTree(events / spread)
    distance, nearest = tree.query(x / spread)
    usual, _ = tree.query(ordinary / spread)
    return NearestEvent(float(distance / root), float(np.mean(usual >= distance)), events[nearest])


MOST_MODES, LEAST_SHOWN = 8, 0.01
"""Modes of a run that are shown with pictures, and the share that these have; the others have a line each."""
CLIP_SECONDS = 3.0
"""Seconds that a clip shows, the last ones up to the end of the drive."""


class Shown(NamedTuple):
    """A scenario driven again, as the page shows it."""

    drive: Drive | None = None
    clip: str = ""
    """Moving picture as a data URI; "" if there is none."""
    figures: Sequence[FigureOfPage] = ()
    missing: str = ""
    """Why there are no pictures; "" if there are."""


class AtlasEntry(NamedTuple):
    """A mode of failure as the page shows it."""

    mode: Mapping[str, Any]
    """What result.json holds of it."""
    others: Mapping[str, str]
    """What other drivers do in its scenarios, in words."""
    f: float = np.nan
    x: FloatArray | None = None
    """The parameters that are shown of its most likely failure, shape (k,)."""
    nearest: NearestEvent | None = None
    """The recorded event that is nearest to it, if there are recordings."""
    shown: Shown | None = None
    """That failure; None where the mode is small and has a line alone."""


def draw_shown(problem: DrivingProblem) -> FloatArray:
    """Return ordinary scenarios, the columns that are shown, shape (n, k)."""
    return draw_ordinary(problem.space)[:, [column.shown for column in list_columns(problem.space)]]


def build_atlas(
    study: LoadedStudy, problem: DrivingProblem, events: FloatArray | None, prefix: str = "", share: float = 1.0
) -> list[AtlasEntry]:
    """Return the entries of all modes, the large ones with pictures, beside recorded events (m, k) if there are any.

    `prefix` stands before the names of figures; `share` is that of the run in what the page is about.
    """
    driven = [name for name in study.result.get("other_drivers") or {} if name != study.question.get("ego")]
    found = list[AtlasEntry]()
    for number, mode in enumerate(study.result.get("modes") or []):
        failure, others = mode.get("failure"), {name: _say_other(study, mode, name) for name in driven}
        entry = AtlasEntry(mode, others)
        large = share * mode["of_failures"] >= LEAST_SHOWN or (number == 0 and share == 1.0)
        if failure is None and large:
            entry = entry._replace(shown=Shown(missing="none of its failures is in failures.csv"))
        elif failure is not None and large and number < MOST_MODES:
            whole = read_row(study.failures, problem, int(failure))
            x = whole[[column.shown for column in list_columns(problem.space)]]
            nearest = None if events is None else find_nearest_event(x, events, draw_shown(problem))
            shown = _show_drive(problem, whole, f"{prefix}mode{number + 1}")
            entry = entry._replace(f=float(study.failures["f"][int(failure)]), x=x, nearest=nearest, shown=shown)
        found.append(entry)
    return found


def _say_other(study: LoadedStudy, mode: Mapping[str, Any], name: str) -> str:
    """Return what another driver does in the scenarios of a mode, and in its most likely failure."""
    each, failure = mode["other_drivers"][name], mode.get("failure")
    f = np.nan if failure is None else float(study.failures[f"f_{name}"][int(failure)])
    here = "" if np.isnan(f) else f", {'but not' if f <= study.result['gamma'] else 'also'} the most likely one"
    return f"avoids {text.format_share(1 - each['fails'])} of {each['n']:,} such scenarios{here}"


def _show_drive(problem: DrivingProblem, x: FloatArray, name: str) -> Shown:
    """Return a scenario driven again with its pictures, or why there are none."""
    try:
        drive = drive_again(problem, x)
        return Shown(drive, encode_clip(drive), _draw_drive(drive, name))
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's, and need not do again what it did before
        return Shown(missing=f"it cannot be shown: {reason_of(error)}")


def _draw_drive(drive: Drive, name: str) -> list[FigureOfPage]:
    """Return the figures of a drive: from above, the measure, and speeds."""

    def draw_measure(figure: Figure) -> None:
        axes = figure.subplots()
        plots.draw_measure(axes, drive)
        axes.legend(loc="upper right", frameon=False)

    height = 0.25 + plots.MOMENTS * max(0.45, 0.03 * drive.road.lanes * drive.road.width)
    return [
        FigureOfPage(
            f"{name}-views", "From above; the ego is green", partial(plots.draw_moments, drive=drive), (4.2, height)
        ),
        FigureOfPage(f"{name}-measure", "The measure over time", draw_measure, (4.2, 2.2)),
        FigureOfPage(
            f"{name}-speeds", "Speeds over time", lambda figure: plots.draw_speeds(figure.subplots(), drive), (4.2, 2.6)
        ),
    ]


def encode_clip(drive: Drive) -> str:
    """Return the last seconds of a drive as a data URI."""
    dt, buffer = drive.problem.world.clock.dt, io.BytesIO()
    plots.save_gif(buffer, plots.draw_frames(drive)[-max(round(CLIP_SECONDS / dt), 2) :], dt)
    return f"data:image/gif;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def write_html_report(
    folder: Path, trust: bool = False, events: Path | None = None, out: Path | None = None, figures: str | None = None
) -> list[Path]:
    """Write the report of a finished run, a risk or a comparison.

    Args:
        folder: Of `rare-envs estimate --out`, `rare-envs risk --out` or `rare-envs compare --out`.
        trust: Let the ego's file run code, and code that a run from elsewhere names: failures are driven again.
        events: CSV file of recorded events with a column for each parameter, for a run; None without.
        out: The file; report.html in the folder by default.
        figures: "svg", "pdf" or "png" for the figures as files too, in a folder `figures` beside the page.

    Returns:
        The files that were written, the page first.

    Raises:
        BadInput: There is no finished run, what it was about cannot be loaded any longer, or nothing can be written.

    Example:
        >>> import tempfile
        >>> from rare_envs.study import Question, prepare, run_into
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", gamma=3.0, method="mc", max_sim=200)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     report = run_into(Path(folder), prepare(question))
        ...     [page.name for page in write_html_report(Path(folder))]
        ['report.html']
    """
    if figures is not None and figures not in drawings.FORMATS:
        raise BadInput(f"Expected --figures {', '.join(drawings.FORMATS)}, got {figures!r}.")
    page = out or folder / REPORT
    name = next((name for name in (RISK, COMPARISON) if (folder / name).is_file()), RESULT)
    if events is not None and name != RESULT:
        raise BadInput(f"Expected --events with the folder of one scenario, not with that of {name}: {str(folder)!r}.")
    study = _load(folder) if name == RESULT else None
    with output_folder(page.parent, page.name, folders=() if figures is None else ("figures",)):
        if study is not None:
            content = _describe_run(study, trust, events)
            content |= {"rows": [(each.mode["of_failures"], "", each) for each in content["atlas"]]}
            content |= {"runs": {"": content}}
        else:
            content = (_describe_risk if name == RISK else _describe_comparison)(folder, trust)
        with _damage_as_bad_input(folder):
            written = render(f"{Path(name).stem}.html.j2", content)
        with as_bad_input(OSError):
            replace_text(page, written)
            return [page, *(each.save(page.parent / "figures", figures) for each in content["drawn"] if figures)]


def render(template: str, content: Mapping[str, Any]) -> str:
    """Return a page by the name of its template; everything that files say is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rare_envs.study.html_report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_keep_numbers_whole,
    )
    environment.globals |= {
        "nouns": text.EVENT_NOUNS,
        "calibrated_within": CALIBRATED_WITHIN,
        "other_nouns": text.OTHER_NOUNS,
        "parts": text.describe_parts,
        "share": text.format_share,
        "sized_by_budget": SIZED_BY_BUDGET,
        "describe_kind": text.describe_kind,
        "name_scenario": text.name_scenario,
        "probability": text.format_probability,
        "contact": describe_contact,
        "value": format_value,
        "with_interval": text.format_with_interval,
        "roles": {**ROLE_COLOURS, "outline: crashed": CRASH_COLOUR},
    }
    return clean_text(environment.get_template(template).render(content))


def _load(folder: Path) -> LoadedStudy:
    """Return a finished run."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # files that changed, which the page names
        return load_finished(folder)


def _describe_run(
    study: LoadedStudy, trust: bool, events: Path | None = None, prefix: str = "", share: float = 1.0
) -> dict[str, Any]:
    """Return what the page says of a run; `prefix` and `share` as in `build_atlas`."""
    folder, question, result = study.folder, open_run(study, trust), study.result
    warn_of_changed_files(question, folder)
    problem = prepare(question).problem
    columns = [column for column in list_columns(problem.space) if column.shown]
    known = None if events is None else read_recorded_events(events, [column.name for column in columns])
    with as_bad_input(OSError):
        changed = study.changed_files
    with _damage_as_bad_input(folder):
        atlas, figures = build_atlas(study, problem, known, prefix, share), _make_figures(study, problem, prefix)
        own, noted = ([str(each) for name in names for each in result.get(name) or []] for names in (["doubts"], NOTED))
        resolved = all(part["resolved"] for part in result.get("parts") or [])
        about, base = study.about.get("base") or {}, result.get("base_uncertainty")
        edited = f"not what the run wrote, by the digests in its {STUDY}: "
        return {
            "title": f"How often does {study.question['ego']} fail in {study.question['env_id']}?",
            "prefix": prefix,
            "result": result,
            "base": base if isinstance(base, dict) else None,
            "about": study.about,
            "folder": str(folder),
            "quoted_folder": shlex.quote(str(folder)),
            "answer": unfold_rows(result["text"][1:]),
            "noun": text.EVENT_NOUNS.get(find_scenario(question.env_id).name, "scenarios"),
            "traffic": Path(about.get("name") or question.base or "of the scenario").name,
            "fitted_to": about.get("fitted_to"),
            "collides": not explain_other_events(question),
            "reference": text.explain_reference(result),
            "doubts": [*([edited + ", ".join(changed)] if changed else []), *own],
            "remarks": [each for each in noted if each not in own],
            "end": describe_outcome(str(result.get("status")), own),
            "no_gain": text.explain_no_gain(float(result["p"]), resolved),
            "figures": {name: figure.to_svg() for name, figure in figures.items()},
            "drawn": [*figures.values(), *(each for entry in atlas if entry.shown for each in entry.shown.figures)],
            "passes_levels": any(level["gamma"] != result["gamma"] for level in result.get("trace") or []),
            "severity": plots.list_severity(result.get("severity")),
            "atlas": atlas,
            "columns": columns,
            "usual": find_ordinary_range(draw_shown(problem)),
        }


def _describe_risk(folder: Path, trust: bool) -> dict[str, Any]:
    """Return what the page says of a risk: its sum, and all that it says of each scenario."""
    total = read_object(folder / RISK)
    with _damage_as_bad_input(folder):
        rates = {name: float(each["per_million_km"]) for name, each in total["scenarios"].items()}
        whole, lines = sum(rates.values()), [str(line) for line in total["text"]]
        last = max(k for k, line in enumerate(lines) if line.startswith("all "))
    runs = {
        name: _describe_run(_load(folder / name), trust, None, f"{name}-", rate / whole if whole else 1.0)
        for name, rate in rates.items()
    }
    with _damage_as_bad_input(folder):
        modes = [
            (rates[name] / whole * entry.mode["of_failures"], name, entry)
            for name, run in runs.items()
            for entry in run["atlas"]
        ]
        return {
            "title": f"How often does {total['ego']} crash?",
            "result": total,
            "headline": " ".join(lines[:1] if "per km" in lines[1] else lines[:2]),
            "answer": unfold_rows(lines[last + 1 :]),
            "doubts": [str(each) for each in total["warnings"]],
            "runs": runs,
            "limits": {name: dict(run["answer"]).get("Limited by", "") for name, run in runs.items()},
            "modes": sorted(modes, key=lambda each: -each[0]),
            "drawn": [each for run in runs.values() for each in run["drawn"]],
        }


def _describe_comparison(folder: Path, trust: bool) -> dict[str, Any]:
    """Return what the page says of a comparison in one scenario, or of one that is summed over several."""
    found = read_object(folder / COMPARISON)
    with _damage_as_bad_input(folder):
        if "question" in found:
            pair = _describe_pair(folder, found, trust)
            return {**pair, "runs": {"": pair}}
        names = [str(name) for name in found["scenarios"]]
    parts = {name: folder / name for name in names}
    runs = {
        name: _describe_pair(part, read_object(part / COMPARISON), trust, f"{name}-") for name, part in parts.items()
    }
    with _damage_as_bad_input(folder):
        return {
            "title": f"{found['ego_a']} (A) against {found['ego_b']} (B)",
            "result": found,
            "answer": found["text"],
            "doubts": [str(each) for each in found["warnings"]],
            "outcomes": list_outcomes({"crashes": found, **found["outcomes"]}),
            "avoided": list_avoided(found["kinds_of_a"]),
            "runs": runs,
            "drawn": [each for run in runs.values() for each in run["drawn"]],
        }


def list_outcomes(found: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return a row for each outcome: its name, A, B and A / B, then both, only A and only B, each with its interval."""
    rows = []
    for name, each in found.items():
        if "per_million_km" in each:
            sides = [(rate, each["intervals_per_million_km"][key]) for key, rate in each["per_million_km"].items()]
        else:
            sides = [(each[key]["p"], each[key]["interval"]) for key in "ab"]
            sides += [(p, each["share_intervals"][key]) for key, p in each["shares"].items() if key != "neither"]
        a, b, *shares = (text.format_with_interval(value, ends) for value, ends in sides)
        ratio = text.format_ratio(each["ratio"], each["interval"])
        rows.append((text.OUTCOME_NOUNS.get(name, name), a, b, ratio, *shares))
    return rows


def list_avoided(kinds: Mapping[str, Mapping[str, float]]) -> list[tuple[str, float, float]]:
    """Return kinds of crash of A with their shares of all, and the share of each that B avoids."""
    sizes = {kind: next(iter(each.values())) for kind, each in kinds.items()}
    return [(kind, size / sum(sizes.values()), kinds[kind]["avoided_by_b"]) for kind, size in sizes.items()]


def _describe_pair(folder: Path, found: Mapping[str, Any], trust: bool, prefix: str = "") -> dict[str, Any]:
    """Return what the page says of a pair of egos in a scenario: their ratio, and the most likely failures of both."""
    with as_bad_input(OSError, ValueError):
        table = read_failures(folder)
    questions = [open_question(each, folder, trust) for each in split_question(found.get("question"))]
    problems = [prepare(question).problem for question in questions]
    with _damage_as_bad_input(folder):
        gamma, shown, columns = float(found["either"]["gamma"]), list[Any](), list_columns(problems[0].space)
        fails = [~(table[f"f_{ego}"] > gamma) for ego in SIDES]  # NaN: it gave no answer, which counts as a failure
        outcomes = {
            "Both fail": fails[0] & fails[1],
            "Only A fails": fails[0] & ~fails[1],
            "Only B fails": fails[1] & ~fails[0],
        }
        for said, rows in outcomes.items():
            for k in np.flatnonzero(rows)[:1].tolist():
                x = read_row(table, problems[0], k)
                drives = [
                    _show_drive(problem, x, f"{prefix}failure{k}-{ego}")
                    for problem, ego in zip(problems, SIDES, strict=True)
                ]
                values = [(column, value) for column, value in zip(columns, x, strict=True) if column.shown]
                shown.append((said, int(rows.sum()), values, drives))
        return {
            "title": f"{questions[0].ego} (A) against {questions[1].ego} (B) in {questions[0].env_id}",
            "result": found,
            "answer": found["text"],
            "better_known": text.is_better_known(found),
            "doubts": [str(each) for each in found["warnings"]],
            "fail": dict(zip([*outcomes, "Neither fails"], found["shares"].values(), strict=True)),
            "outcomes": list_outcomes({"failures": found, **found["severity"]}),
            "avoided": list_avoided(found["kinds_of_a"]),
            "shown": shown,
            "n_listed": len(table["f"]),
            "drawn": [each for *_, drives in shown for drive in drives for each in drive.figures],
        }


NOTED = ("warnings", "remarks", "notes")
"""Lists of result.json that are remarks of the page, as far as they are no doubts."""


def _keep_numbers_whole(value: object) -> object:
    """Return text without line breaks within its numbers; anything else, pictures and styles too, as it is."""
    return BROKEN_NUMBER.sub("\xa0", value) if isinstance(value, str) and not isinstance(value, Markup) else value


@contextlib.contextmanager
def _damage_as_bad_input(folder: Path) -> Iterator[None]:
    """Raise what files of somebody else's making lead to as a BadInput."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, jinja2.TemplateError) as error:
        files = " or ".join(name for name in (RESULT, STUDY, RISK, COMPARISON) if (folder / name).is_file())
        raise BadInput(f"{files} in {str(folder)!r} is damaged: {one_line(error)}.") from error


def _make_figures(study: LoadedStudy, problem: DrivingProblem, prefix: str) -> dict[str, FigureOfPage]:
    """Return the figures of the run by name."""
    columns, ordinary = [column for column in list_columns(problem.space) if column.shown], draw_shown(problem)
    failing, log_weights = _read_failing(study, [column.name for column in columns])
    weighted = ~np.isnan(log_weights)
    measure = text.name_measure(str(study.question.get("measure", "")))
    figures = drawings.figures_of_result(study.result, measure, prefix)
    if len(failing) and columns:
        weights = np.ones(len(failing))
        if weighted.any():
            failing, weights = failing[weighted], np.exp(log_weights[weighted])
        shift = np.abs(np.average(failing, axis=0, weights=weights) - ordinary.mean(axis=0))
        order = np.argsort(-shift / np.maximum(ordinary.std(axis=0), 1e-12), kind="stable")[: drawings.MAX_HISTOGRAMS]
        labels = [columns[j].label for j in order]
        figures["parameters"] = drawings.figure_of_parameters(
            ordinary[:, order], failing[:, order], weights, labels, prefix
        )
    return figures


def _read_failing(study: LoadedStudy, names: list[str]) -> tuple[FloatArray, FloatArray]:
    """Return the failing simulations, the columns asked for (k, m) and log weights (k,), NaN if there is none."""
    if not (study.folder / EPISODES).exists():
        table = [np.asarray(study.failures[name], dtype=float) for name in names if name in study.failures]
        x = np.column_stack(table) if len(table) == len(names) else np.empty((0, len(names)))
        return x, np.full(len(x), np.nan)
    with as_bad_input(ValueError, OSError):
        found = study.episodes([*names, "log_weight"], failed=True)
    x = np.column_stack([found[name].to_numpy() for name in names]) if names else np.empty((found.num_rows, 0))
    return x, found["log_weight"].to_numpy().astype(float)
