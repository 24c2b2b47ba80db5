"""Record of a reproduction: a paper's numbers beside ours, what made them, its Markdown, and the folder of the runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import rare_envs
from benchmarks.samplers.runs import about
from rare_envs.files import format_json
from rare_envs.study.arguments import BadInput
from samplers.output import to_json_value

NOTHING = "–"
"""Text of a cell without content."""


@dataclass(frozen=True, kw_only=True)
class ComparedValue:
    """One number of a paper's table beside ours.

    Example:
        >>> value = ComparedValue(labels=("SS", "IDM"), quantity="mean of p", paper=8.0e-4, ours=8.4e-4)
        >>> f"{value.difference:+.0%}"
        '+5%'
    """

    labels: tuple[str, ...]
    """Row of the table: the method, the system under test and so on."""
    quantity: str
    paper: float | None = None
    """As printed; None where the paper has none."""
    ours: float | None = None
    interval: tuple[float, float] | None = None
    """95 % interval of ours."""
    paper_all_in: float | None = None
    """The paper's number with every simulation counted, the search among them; None where that is not known."""
    ours_all_in: float | None = None
    released: str = ""
    """What the released code does or gives, in words."""
    reasons: tuple[str, ...] = ()
    """Why the two differ: names of explanations of the table."""

    @property
    def difference(self) -> float | None:
        """Ours over the paper's, less 1; None where one of them is not known, or negative."""
        if self.ours is None or not self.paper or min(self.ours, self.paper) < 0.0:
            return None
        return self.ours / self.paper - 1.0


@dataclass(frozen=True, kw_only=True)
class ComparisonTable:
    """A table of a paper beside ours."""

    name: str
    """A word, unique in the record: `table2`."""
    title: str
    keys: tuple[str, ...]
    """Heads of the columns of the labels."""
    values: tuple[ComparedValue, ...]
    explanations: Mapping[str, str] = field(default_factory=dict)
    """Sentences by the names that the values have as reasons."""
    measured: tuple[Mapping[str, Any], ...] = ()
    """Rows of ours alone, shown below: `labels`, and `values` by quantity, the same quantities in every row."""
    measured_title: str = ""
    all_in_title: str = "all simulations"
    """Of the columns with every simulation counted."""

    def __post_init__(self) -> None:
        for labels in (*(value.labels for value in self.values), *(row["labels"] for row in self.measured)):
            if len(labels) != len(self.keys):
                raise ValueError(f"Expected {len(self.keys)} labels ({', '.join(self.keys)}), got {labels}.")
        for reason in (reason for value in self.values for reason in value.reasons):
            if reason not in self.explanations:
                raise ValueError(f"No explanation {reason!r} in the table; known: {', '.join(self.explanations)}.")

    def to_dict(self) -> dict[str, Any]:
        """Return the table as a record has it."""
        values = [{**asdict(value), "difference": value.difference} for value in self.values]
        return {**asdict(self), "values": values}


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A statement of a paper, and the test statistic that says whether it is so here."""

    claim: str
    statistic: str
    """What is computed, in words."""
    value: float | None
    interval: tuple[float, float] | None
    """95 % interval of the statistic."""
    verdict: str
    """In a few words: holds, does not hold here, cannot be told."""


@dataclass(frozen=True)
class DrawnFigure:
    """A figure of a record: the name that its data have there, and its drawing."""

    name: str
    draw: Callable[[Figure], None]
    size: tuple[float, float]
    """[inches]."""


def make_record(
    *,
    title: str,
    source: str,
    command: str,
    settings: Mapping[str, Any],
    tables: Sequence[ComparisonTable],
    figures: Mapping[str, Mapping[str, Any]],
    findings: Sequence[Finding] = (),
    notes: Sequence[str] = (),
    runs: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Return a record as plain values for JSON.

    Args:
        title: Of the page.
        source: The paper: authors, title, place, year.
        command: As typed.
        settings: Scale, seeds, replications and whatever else the numbers depend on.
        tables: The paper's tables beside ours.
        figures: Data of the figures by their names, with `caption` and `paper`: what the figure shows, and what the
            printed one shows.
        findings: The paper's statements, tested.
        notes: What holds for all of it, in sentences.
        runs: The single runs.
    """
    libraries = {name: _find_version(name) for name in ("torch", "numba", "gymnasium")}
    record: dict[str, Any] = to_json_value(
        {
            "title": title,
            "source": source,
            "command": command,
            "about": about(rare_envs=rare_envs.__version__, **libraries, **settings),
            "notes": list(notes),
            "tables": [table.to_dict() for table in tables],
            "findings": [asdict(finding) for finding in findings],
            "figures": dict(figures),
            "runs": [dict(run) for run in runs],
        }
    )
    return record


def _find_version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "not installed"


def write_record(out: Path, record: Mapping[str, Any], figures: Sequence[DrawnFigure]) -> None:
    """Write a record as JSON and as Markdown, and its figures as PNG files, into a folder that exists."""
    (out / "reproduction.json").write_text(format_json(dict(record)) + "\n", encoding="utf-8")
    (out / "reproduction.md").write_text(format_record(record), encoding="utf-8")
    for each in figures:
        figure = Figure(figsize=each.size, layout="constrained")
        each.draw(figure)
        figure.savefig(out / f"{each.name}.png", dpi=150)


def check_folder(out: Path, study: Mapping[str, Any]) -> None:
    """Refuse a folder with runs of another paper, seed, scale or ego.

    Args:
        out: Folder of the files; it need not exist.
        study: What the runs are to be of, as the first line of each file of runs has it under `study`.

    Raises:
        BadInput: A file of runs in the folder is of something else.
    """
    for file in sorted(out.glob("*.jsonl")):
        held = _read_study(file)
        if held is not None and held != study:
            raise BadInput(
                f"{out} holds {_describe_study(held)}; this is {_describe_study(study)}: choose another --out."
            )


def discard_runs(file: Path, paper: str) -> None:
    """Delete a file of runs if they are of a paper; others stay, for `check_folder` to refuse."""
    held = _read_study(file) if file.is_file() else {}
    if held is None or held.get("paper") == paper:
        file.unlink()


def _read_study(file: Path) -> Mapping[str, Any] | None:
    """Return what the runs of a file are of; None for a file without a whole line."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        first = lines.readline()
    if not first.endswith("\n"):
        return None
    try:
        study = json.loads(first)["study"]
    except (ValueError, KeyError, TypeError):
        return {}
    return study if isinstance(study, dict) else {}


def _describe_study(study: Mapping[str, Any]) -> str:
    if not study:
        return "runs of another command or version"
    return ", ".join(str(value) if name == "paper" else f"{name} {value}" for name, value in study.items())


def format_record(record: Mapping[str, Any]) -> str:
    """Return the tables, explanations and findings of a record as Markdown, under a heading of level 2."""
    about = record["about"]
    versions = f"rare_envs {about['rare_envs']}, NumPy {about['numpy']}, Python {about['python']}, {about['processor']}"
    lines = [f"## {record['title']}", "", record["source"], "", f"Made by `{record['command']}` ({versions}).", ""]
    lines += [f"- {note}" for note in record["notes"]]
    for table in record["tables"]:
        lines += ["", f"### {table['title']}", "", *_format_compared(table), ""]
        if table["measured"]:
            heads = [*table["keys"], *table["measured"][0]["values"]]
            rows = [[*row["labels"], *map(format_number, row["values"].values())] for row in table["measured"]]
            lines += [f"{table['measured_title']}:", "", *_format_rows(heads, rows), ""]
        lines += [f"- *{name}*: {text}" for name, text in table["explanations"].items()]
    if record["findings"]:
        rows = [
            [row["claim"], row["statistic"], format_number(row["value"]), format_ends(row["interval"]), row["verdict"]]
            for row in record["findings"]
        ]
        lines += ["", "### Findings", ""]
        lines += _format_rows(["statement", "statistic", "value", "95 % interval", "here"], rows)
    if record["figures"]:
        lines += ["", "### Figures", ""]
    lines += [
        f"- {each['title']} {each['caption']} In the paper: {each['paper']}" for each in record["figures"].values()
    ]
    return "\n".join(lines) + "\n"


def _format_compared(table: Mapping[str, Any]) -> Iterator[str]:
    """Return a table of a record as Markdown; what no value has is no column, and labels stand once."""
    columns = {
        head: [show(value) for value in table["values"]] for head, show in _columns(table["all_in_title"]).items()
    }
    shown = {head: cells for head, cells in columns.items() if set(cells) != {NOTHING}}
    labels: list[list[str]] = []
    for label, group in groupby(value["labels"] for value in table["values"]):
        labels += [label, *([""] * len(label) for _ in list(group)[1:])]
    rows = [[*label, *cells] for label, *cells in zip(labels, *shown.values(), strict=True)]
    return _format_rows([*table["keys"], *shown], rows)


def _columns(all_in: str) -> dict[str, Callable[[Mapping[str, Any]], str]]:
    """Return the columns behind those of the labels: how each shows a value."""
    return {
        "quantity": lambda value: str(value["quantity"]),
        "paper": lambda value: format_number(value["paper"]),
        "ours": lambda value: format_number(value["ours"]),
        "95 % interval": lambda value: format_ends(value["interval"]),
        "difference": lambda value: format_difference(value["difference"]),
        f"paper, {all_in}": lambda value: format_number(value["paper_all_in"]),
        f"ours, {all_in}": lambda value: format_number(value["ours_all_in"]),
        "released code": lambda value: value["released"] or NOTHING,
        "why they differ": lambda value: ", ".join(value["reasons"]) or NOTHING,
    }


def format_number(value: float | None) -> str:
    """Return a number of a table, whatever its size; an en dash for None.

    Example:
        >>> [format_number(value) for value in (2.392e-4, 0.0862, 406_400.0, 20, None)]
        ['2.39e-04', '0.0862', '406,400', '20', '–']
    """
    if value is None:
        return NOTHING
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.2e}" if 0 < abs(value) < 1e-3 else f"{value:.3g}"


def format_difference(value: float | None) -> str:
    """Return a relative difference in percent, or as a factor where it is large.

    Example:
        >>> [format_difference(value) for value in (0.05, -0.2, 20.4, -0.99, None)]
        ['+5 %', '-20 %', '× 21.4', '× 0.01', '–']
    """
    if value is None:
        return NOTHING
    return f"× {format_number(1.0 + value)}" if value > 2.0 or value < -0.9 else f"{100 * value:+.0f} %"


def format_ends(interval: Sequence[float] | None) -> str:
    """Return the ends of an interval as text."""
    return NOTHING if interval is None else f"{format_number(interval[0])} to {format_number(interval[1])}"


def _format_rows(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(heads)} |"
    yield "|---" * len(heads) + "|"
    yield from (f"| {' | '.join(row)} |" for row in rows)
