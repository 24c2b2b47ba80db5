"""Page: the report of a run, from its folder to one HTML file."""

from __future__ import annotations

import base64
import contextlib
import io
import re
import shlex
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial import KDTree

from rare_envs.envs.rendering import CRASH_COLOUR, FRAME_WIDTH, ROLE_COLOURS
from rare_envs.files import replace_text
from rare_envs.plugins import EgoGone, clean_text, one_line, reason_of
from rare_envs.problem import DrivingProblem
from rare_envs.study import plots, text
from rare_envs.study.arguments import BadInput, as_bad_input, output_folder
from rare_envs.study.episodes import draw_ordinary, find_ordinary_range, format_value, list_columns
from rare_envs.study.html_report import figures as drawings
from rare_envs.study.html_report.figures import FigureOfPage
from rare_envs.study.question import open_run, prepare, warn_of_changed_files
from rare_envs.study.replay import Drive, describe_contact, drive_again, read_row
from rare_envs.study.run_folder import EPISODES, REPORT, RESULT, STUDY, LoadedStudy, load_finished
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


MOST_MODES = 8
"""Modes that are shown with pictures; the others have a row in the table."""
CLIP_WIDTH, CLIP_SECONDS = 560, 3.0
"""Width of a clip [pixels], and seconds that it shows, the last ones up to the end of the drive."""


class AtlasEntry(NamedTuple):
    """A mode of failure as the page shows it."""

    mode: Mapping[str, Any]
    """What result.json holds of it."""
    f: float = np.nan
    x: FloatArray | None = None
    """The parameters that are shown of its most likely failure, shape (k,)."""
    nearest: NearestEvent | None = None
    """The recorded event that is nearest to it, if there are recordings."""
    drive: Drive | None = None
    """That failure driven again."""
    clip: str = ""
    """Moving picture as a data URI; "" if there is none."""
    figures: Sequence[FigureOfPage] = ()
    missing: str = ""
    """Why there are no pictures; "" if there are."""


def draw_shown(problem: DrivingProblem) -> FloatArray:
    """Return ordinary scenarios, the columns that are shown, shape (n, k)."""
    return draw_ordinary(problem.space)[:, [column.shown for column in list_columns(problem.space)]]


def build_atlas(study: LoadedStudy, problem: DrivingProblem, events: FloatArray | None) -> list[AtlasEntry]:
    """Return the entries of the largest modes; `events` (m, k) are recorded ones, if there are any."""
    modes = list(study.result.get("modes") or [])[:MOST_MODES]
    return [_build_entry(study, problem, events, number, mode) for number, mode in enumerate(modes, 1)]


def _build_entry(
    study: LoadedStudy, problem: DrivingProblem, events: FloatArray | None, number: int, mode: Mapping[str, Any]
) -> AtlasEntry:
    failure = mode.get("failure")
    if failure is None:
        return AtlasEntry(mode, missing="none of its failures is in failures.csv")
    whole = read_row(study.failures, problem, int(failure))
    x = whole[[column.shown for column in list_columns(problem.space)]]
    nearest = None if events is None else find_nearest_event(x, events, draw_shown(problem))
    entry = AtlasEntry(mode, float(study.failures["f"][int(failure)]), x, nearest)
    try:
        drive = drive_again(problem, whole)
        figures, clip = _draw_drive(drive, number), encode_clip(drive)
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's, and need not do again what it did before
        return entry._replace(missing=f"it cannot be shown: {reason_of(error)}")
    return entry._replace(drive=drive, clip=clip, figures=figures)


def _draw_drive(drive: Drive, number: int) -> list[FigureOfPage]:
    """Return the figures of a drive: from above, the measure, and speeds."""

    def draw_views(figure: Figure) -> None:
        for axes, t in zip(figure.subplots(plots.MOMENTS, 1), plots.choose_moments(drive), strict=True):
            plots.draw_moment(axes, drive, t)

    def draw_measure(figure: Figure) -> None:
        axes = figure.subplots()
        plots.draw_measure(axes, drive)
        axes.legend(frameon=False, fontsize=8)

    def draw_speeds(figure: Figure) -> None:
        plots.draw_speeds(figure.subplots(), drive)

    height = 0.25 + plots.MOMENTS * max(0.6, 0.045 * drive.road.lanes * drive.road.width)
    return [
        FigureOfPage(f"mode{number}-views", "From above; the ego is green", draw_views, (6.4, height)),
        FigureOfPage(f"mode{number}-measure", "The measure over time", draw_measure, (6.4, 2.2)),
        FigureOfPage(f"mode{number}-speeds", "Speeds over time", draw_speeds, (6.4, 2.8)),
    ]


def encode_clip(drive: Drive) -> str:
    """Return the last seconds of a drive as a data URI."""
    dt, buffer = drive.problem.world.clock.dt, io.BytesIO()
    frames = plots.draw_frames(drive)[-max(round(CLIP_SECONDS / dt), 2) :]
    size = (CLIP_WIDTH, round(frames[0].height * CLIP_WIDTH / FRAME_WIDTH))
    plots.save_gif(buffer, [frame.resize(size, Image.Resampling.LANCZOS) for frame in frames], dt)
    return f"data:image/gif;base64,{base64.b64encode(buffer.getvalue()).decode()}"


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
    if figures is not None and figures not in drawings.FORMATS:
        raise BadInput(f"Expected --figures {', '.join(drawings.FORMATS)}, got {figures!r}.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # files that changed, which the page names
        study, page = load_finished(folder), out or folder / REPORT
    with output_folder(page.parent, page.name, folders=() if figures is None else ("figures",)):
        question = open_run(study, trust)
        warn_of_changed_files(question, folder)
        problem = prepare(question).problem
        shown = [column.name for column in list_columns(problem.space) if column.shown]
        known = None if events is None else read_recorded_events(events, shown)
        with _damage_as_bad_input(folder):
            atlas, drawn = build_atlas(study, problem, known), _make_figures(study, problem)
            content = render_page(study, problem, drawn, atlas)
        with as_bad_input(OSError):
            replace_text(page, content)
            if figures is None:
                return [page]
            every = [*drawn.values(), *(figure for entry in atlas for figure in entry.figures)]
            return [page, *(figure.save(page.parent / "figures", figures) for figure in every)]


def render_page(
    study: LoadedStudy, problem: DrivingProblem, figures: Mapping[str, FigureOfPage], atlas: Sequence[AtlasEntry]
) -> str:
    """Return the page as text; everything that files say is escaped."""
    result, base = study.result, study.result.get("base_uncertainty")
    with as_bad_input(OSError):
        changed = study.changed_files
    doubts = [f"not what the run wrote, by the digests in its {STUDY}: {', '.join(changed)}"] if changed else []
    own, noted = ([str(each) for name in names for each in result.get(name) or []] for names in (["doubts"], NOTED))
    doubts += own
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rare_envs.study.html_report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_keep_numbers_whole,
    )
    page = environment.get_template("report.html.j2").render(
        result=result,
        question=result.get("question") or {},
        base=base if isinstance(base, dict) else None,
        about=study.about,
        folder=str(study.folder),
        quoted_folder=shlex.quote(str(study.folder)),
        answer=unfold_rows(result["text"][1:]),
        doubts=doubts,
        remarks=[each for each in noted if each not in own],
        end=describe_outcome(str(result.get("status")), own),
        no_gain=text.explain_no_gain(float(result["p"]), all(part["resolved"] for part in result.get("parts") or [])),
        nouns=text.EVENT_NOUNS,
        parts=text.describe_parts,
        share=text.format_share,
        sized_by_budget=SIZED_BY_BUDGET,
        figures={name: figure.to_svg() for name, figure in figures.items()},
        passes_levels=any(level["gamma"] != result["gamma"] for level in result.get("trace") or []),
        severity=plots.list_severity(result.get("severity")),
        atlas=atlas,
        columns=[column for column in list_columns(problem.space) if column.shown],
        usual=find_ordinary_range(draw_shown(problem)),
        describe_kind=text.describe_kind,
        probability=text.format_probability,
        contact=describe_contact,
        value=format_value,
        with_interval=text.format_with_interval,
        roles={**ROLE_COLOURS, "outline: crashed": CRASH_COLOUR},
    )
    return clean_text(page)


NOTED = ("warnings", "remarks", "notes")
"""Lists of result.json that are remarks of the page, as far as they are no doubts."""


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


def _make_figures(study: LoadedStudy, problem: DrivingProblem) -> dict[str, FigureOfPage]:
    """Return the figures of the run by name."""
    columns, ordinary = [column for column in list_columns(problem.space) if column.shown], draw_shown(problem)
    failing, log_weights = _read_failing(study, [column.name for column in columns])
    weighted = ~np.isnan(log_weights)
    measure = text.name_measure(str(study.question.get("measure", "")))
    figures = drawings.figures_of_result(study.result, measure)
    if len(failing) and columns:
        weights = np.ones(len(failing))
        if weighted.any():
            failing, weights = failing[weighted], np.exp(log_weights[weighted])
        shift = np.abs(np.average(failing, axis=0, weights=weights) - ordinary.mean(axis=0))
        order = np.argsort(-shift / np.maximum(ordinary.std(axis=0), 1e-12), kind="stable")[: drawings.MAX_HISTOGRAMS]
        labels = [columns[j].label for j in order]
        figures["parameters"] = drawings.figure_of_parameters(ordinary[:, order], failing[:, order], weights, labels)
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
