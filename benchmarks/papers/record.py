"""Record of a reproduction: a paper's numbers beside ours, what made them, and the folder of the runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

import rare_envs
from benchmarks.papers.markdown import format_reproduction
from benchmarks.samplers.runs import about
from rare_envs.files import format_json
from rare_envs.study.errors import BadInput
from samplers.output import to_json_value


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
    """Ours likewise."""
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

    def to_dict(self) -> dict[str, Any]:
        """Return the value and the difference as a record has them."""
        return {**asdict(self), "difference": self.difference}


@dataclass(frozen=True, kw_only=True)
class MeasuredRow:
    """Numbers of ours in a row of their own, where the paper has nothing to stand beside them."""

    labels: tuple[str, ...]
    values: Mapping[str, float | None]
    """By quantity; the same quantities in every row of a table."""


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
    measured: tuple[MeasuredRow, ...] = ()
    """Further rows of ours, shown below."""
    measured_title: str = ""
    all_in_title: str = "all simulations"
    """Of the columns with every simulation counted."""

    def __post_init__(self) -> None:
        for labels in (*(value.labels for value in self.values), *(row.labels for row in self.measured)):
            if len(labels) != len(self.keys):
                raise ValueError(f"Expected {len(self.keys)} labels ({', '.join(self.keys)}), got {labels}.")
        for value in self.values:
            unknown = [reason for reason in value.reasons if reason not in self.explanations]
            if unknown:
                raise ValueError(f"No explanation {unknown[0]!r} in the table; known: {', '.join(self.explanations)}.")

    def to_dict(self) -> dict[str, Any]:
        """Return the table as a record has it."""
        return {
            "name": self.name,
            "title": self.title,
            "keys": list(self.keys),
            "values": [value.to_dict() for value in self.values],
            "explanations": dict(self.explanations),
            "all_in_title": self.all_in_title,
            "measured_title": self.measured_title,
            "measured": [{"labels": row.labels, "values": dict(row.values)} for row in self.measured],
        }


@dataclass(frozen=True, kw_only=True)
class TestedClaim:
    """A statement of a paper, and the test statistic that says whether it is so here.

    Example:
        >>> finding = TestedClaim(claim="A needs fewer runs than B", statistic="runs of B / runs of A",
        ...                   value=2.1, interval=(1.8, 2.4), verdict="holds")
        >>> finding.to_dict()["verdict"]
        'holds'
    """

    claim: str
    statistic: str
    """What is computed, in words."""
    value: float | None
    interval: tuple[float, float] | None
    """95 % interval of the statistic."""
    verdict: str
    """In a few words: holds, does not hold here, cannot be told."""

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as a record has it."""
        return asdict(self)


def check_reproduction_folder(out: Path, study: Mapping[str, Any]) -> None:
    """Refuse a folder with runs of another paper, seed, scale or ego.

    Args:
        out: Folder of the files; it need not exist.
        study: What the runs are to be of, as the first line of each file of runs has it under `study`.

    Raises:
        BadInput: A file of runs in the folder is of something else.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with Path(folder, "runs.jsonl").open("w") as file:
        ...         print('{"study": {"paper": "tian2024", "seed": 0}}', file=file)
        ...     check_reproduction_folder(Path(folder), {"paper": "tian2024", "seed": 0})  # these runs go on
    """
    for file in sorted(out.glob("*.jsonl")):
        held = _read_study(file)
        if held is not None and held != study:
            raise BadInput(
                f"{out} holds {_describe_study(held)}; this is {_describe_study(study)}: choose another --out."
            )


def discard_runs(file: Path, paper: str) -> None:
    """Delete a file of runs if they are of a paper; others stay, for `check_reproduction_folder` to refuse.

    Args:
        file: Which need not exist.
        paper: By its name on the command line.
    """
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
    """Return what runs are of in words."""
    if not study:
        return "runs of another command or version"
    return ", ".join(str(value) if name == "paper" else f"{name} {value}" for name, value in study.items())


REPRODUCTION_FILE, REPRODUCTION_TEXT = "reproduction.json", "reproduction.md"
_LIBRARIES = ("torch", "numba", "gymnasium")


def make_record(
    *,
    title: str,
    source: str,
    command: str,
    settings: Mapping[str, Any],
    tables: Sequence[ComparisonTable],
    figures: Mapping[str, Mapping[str, Any]],
    findings: Sequence[TestedClaim] = (),
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
    made_by = about(rare_envs=rare_envs.__version__, **_library_versions(), **settings)
    record: dict[str, Any] = to_json_value(
        {
            "title": title,
            "source": source,
            "command": command,
            "about": made_by,
            "notes": list(notes),
            "tables": [table.to_dict() for table in tables],
            "findings": [finding.to_dict() for finding in findings],
            "figures": dict(figures),
            "runs": [dict(run) for run in runs],
        }
    )
    return record


class DrawnFigure(NamedTuple):
    """A figure of a record."""

    name: str
    """That its data have in the record, and its file."""
    draw: Callable[[Figure], None]
    size: tuple[float, float]
    """[inches]."""

    def save(self, folder: Path) -> None:
        """Write the figure as a PNG file."""
        figure = Figure(figsize=self.size, layout="constrained")
        self.draw(figure)
        figure.savefig(folder / f"{self.name}.png", dpi=150)


def write_record(out: Path, record: Mapping[str, Any], figures: Sequence[DrawnFigure]) -> None:
    """Write a record as JSON and as Markdown, and its figures as PNG files, into a folder that exists."""
    (out / REPRODUCTION_FILE).write_text(format_json(dict(record)) + "\n", encoding="utf-8")
    (out / REPRODUCTION_TEXT).write_text(format_reproduction(record), encoding="utf-8")
    for figure in figures:
        figure.save(out)


def _library_versions() -> dict[str, str]:
    found = {}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
