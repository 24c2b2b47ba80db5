"""Page: the report of a run, from its folder to one HTML file."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from rare_envs.envs.rendering import CRASH_COLOUR, ROLE_COLOURS
from rare_envs.files import replace_text
from rare_envs.plugins import one_line
from rare_envs.study.arguments import BadInput, as_bad_input, output_file, output_folder
from rare_envs.study.episodes import draw_ordinary, list_columns
from rare_envs.study.html_report.atlas import AtlasEntry, AtlasSource, build_atlas, read_recorded_events
from rare_envs.study.html_report.figures import (
    FORMATS,
    MAX_HISTOGRAMS,
    FigureOfPage,
    figure_of_parameters,
    figures_of_result,
    passes_levels,
)
from rare_envs.study.question import open_run, prepare, warn_of_changed_files
from rare_envs.study.run_folder import EPISODES, REPORT, RESULT, STUDY, LoadedStudy, load_finished
from rare_envs.study.text import (
    describe_intervals,
    describe_kind,
    describe_method,
    describe_rate,
    describe_wide_base,
    explain_no_gain,
    format_probability,
    name_measure,
    summarise_answer,
)
from samplers.problem import FloatArray
from samplers.sample import describe_outcome

__all__ = ["write_html_report"]

BROKEN_NUMBER = re.compile(r"(?<=\d) (?=%|× 10)|(?<=×) (?=10)")
"""Spaces within a number: "0.12 %", "3.1 × 10⁻⁵"."""
SECTIONS = ("warnings", "answer", "convergence", "levels", "weights", "curve", "parameters", "kinds", "atlas", "made")
"""Ids of the sections of the page, in their order."""


def write_html_report(
    folder: Path, trust: bool = False, events: Path | None = None, out: Path | None = None, figures: str | None = None
) -> list[Path]:
    """Write the report of a finished run.

    Args:
        folder: Of the run.
        trust: Let the ego's file run code, and code that a run from elsewhere names: failures are driven again.
        events: CSV file of recorded events with a column for each parameter; None without.
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
    if figures is not None and figures not in FORMATS:
        raise BadInput(f"Expected --figures {', '.join(FORMATS)}, got {figures!r}.")
    study, page = load_finished(folder), out or folder / REPORT
    with output_file(page):
        question = open_run(study, trust)
        warn_of_changed_files(question, folder)
        problem = prepare(question).problem
        shown = [column.name for column in list_columns(problem.space) if column.shown]
        known = None if events is None else read_recorded_events(events, shown)
        source = AtlasSource(folder, problem, study.failures, draw_ordinary(problem.space), known)
        with _damage_as_bad_input(folder):
            atlas = build_atlas(source, list(study.result.get("modes") or []))
            drawn = _make_figures(study, source)
            text = render_page(study, drawn, atlas)
        with as_bad_input(OSError):
            replace_text(page, text)
            if figures is None:
                return [page]
            every = [*drawn.values(), *(figure for entry in atlas for figure in entry.figures)]
            with output_folder(page.parent / "figures"):
                return [page, *(figure.save(page.parent / "figures", figures) for figure in every)]


def render_page(study: LoadedStudy, figures: Mapping[str, FigureOfPage], atlas: Sequence[AtlasEntry]) -> str:
    """Return the page as text; everything that files say is escaped."""
    result = study.result
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rare_envs.study.html_report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_keep_numbers_whole,
    )
    doubts = _list_texts(result, "doubts")
    return environment.get_template("report.html.j2").render(
        result=result,
        about=study.about,
        folder=str(study.folder),
        summary=summarise_answer(result, str((study.about.get("base") or {}).get("name") or "its default base")),
        doubts=[*_describe_changes(study), *doubts, *filter(None, [describe_wide_base(result)])],
        remarks=[text for text in _list_texts(result, "warnings", "remarks", "notes") if text not in doubts],
        intervals=describe_intervals(result),
        validity=str(result.get("valid", "")),
        end=describe_outcome(str(result.get("status")), doubts),
        no_gain=explain_no_gain(float(result["p"])),
        rate=describe_rate(result),
        method=describe_method(result),
        figures={name: figure.to_svg() for name, figure in figures.items()},
        passes_levels=passes_levels(result),
        atlas=atlas,
        svgs={figure.name: figure.to_svg() for entry in atlas for figure in entry.figures},
        kinds=[(describe_kind(kind), share) for kind, share in (result.get("kinds") or {}).items()],
        probability=format_probability,
        roles={**ROLE_COLOURS, "outline: crashed": CRASH_COLOUR},
    )


def _keep_numbers_whole(value: object) -> object:
    """Return text without line breaks within its numbers; anything else, pictures and styles too, as it is."""
    return BROKEN_NUMBER.sub("\xa0", value) if isinstance(value, str) and not isinstance(value, Markup) else value


@contextlib.contextmanager
def _damage_as_bad_input(folder: Path) -> Iterator[None]:
    """Raise what a result.json or study.json of somebody else's making leads to as a BadInput."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, jinja2.TemplateError) as error:
        raise BadInput(f"{RESULT} or {STUDY} in {str(folder)!r} is damaged: {one_line(error)}.") from error


def _describe_changes(study: LoadedStudy) -> list[str]:
    """Return a warning of files that are not what the run wrote, if there are any."""
    with as_bad_input(OSError):
        changed = study.changed_files
    return [f"not what the run wrote, by the digests in its {STUDY}: {', '.join(changed)}"] if changed else []


def _list_texts(result: Mapping[str, Any], *names: str) -> list[str]:
    """Return the texts that some entries of a result list."""
    return [str(text) for name in names for text in result.get(name) or []]


def _make_figures(study: LoadedStudy, source: AtlasSource) -> dict[str, FigureOfPage]:
    """Return the figures of the run by name."""
    every = list_columns(source.problem.space)
    columns, ordinary = [each for each in every if each.shown], source.ordinary[:, [each.shown for each in every]]
    failing, log_weights = _read_failing(study, [column.name for column in columns])
    weighted = ~np.isnan(log_weights)
    measure = name_measure(str(study.question.get("measure", "")))
    figures = figures_of_result(study.result, log_weights[weighted], measure)
    if len(failing) and columns:
        weights = np.ones(len(failing))
        if weighted.any():
            failing, weights = failing[weighted], np.exp(log_weights[weighted])
        shift = np.abs(np.average(failing, axis=0, weights=weights) - ordinary.mean(axis=0))
        order = np.argsort(-shift / np.maximum(ordinary.std(axis=0), 1e-12), kind="stable")[:MAX_HISTOGRAMS]
        labels = [columns[j].label for j in order]
        figures["parameters"] = figure_of_parameters(ordinary[:, order], failing[:, order], weights, labels)
    return figures


def _read_failing(study: LoadedStudy, names: list[str]) -> tuple[FloatArray, FloatArray]:
    """Return the failing simulations, the columns asked for (k, m) and log weights (k,), NaN where there is none."""
    if not (study.folder / EPISODES).exists():
        table = [np.asarray(study.failures[name], dtype=float) for name in names if name in study.failures]
        x = np.column_stack(table) if len(table) == len(names) else np.empty((0, len(names)))
        return x, np.full(len(x), np.nan)
    with as_bad_input(ValueError, OSError):
        found = study.episodes([*names, "log_weight"], failed=True)
    x = np.column_stack([found[name].to_numpy() for name in names]) if names else np.empty((found.num_rows, 0))
    return x, found["log_weight"].to_numpy().astype(float)
