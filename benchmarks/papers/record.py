"""Record of a reproduction: a paper's numbers beside ours, what made them, its Markdown, and the folder of the runs.

Values, tables and findings are mappings, as the JSON of the record has them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import rare_envs
from benchmarks import format_table
from benchmarks.samplers.runs import about
from rare_envs.files import format_json
from rare_envs.study.arguments import BadInput
from samplers.output import to_json_value

NOTHING = "–"
"""Text of a cell without content."""
Entry = dict[str, Any]
"""A value, table or finding of a record."""
Drawings = Mapping[str, tuple[Callable[[Figure], None], tuple[float, float]]]
"""Figures by the names that their data have in a record: what draws them, and their size [inches]."""


def compare(labels: Sequence[str], quantity: str, paper: float | None = None, **more: Any) -> Entry:
    """Return one number of a paper's table beside ours; None where one of them is not known.

    `labels` tell the row of the table: the method, the system under test and so on. Further entries are `ours` and its
    95 % `interval`; `paper_all_in` and `ours_all_in`, with every simulation counted, the search among them; what the
    `released` code does, in words; and `reasons` why the two differ, names of explanations of the table.

    Example:
        >>> f"{compare(('SS', 'IDM'), 'mean of p', 8.0e-4, ours=8.4e-4)['difference']:+.0%}"
        '+5%'
    """
    usual = {"ours": None, "interval": None, "paper_all_in": None, "ours_all_in": None, "released": "", "reasons": ()}
    value = {"labels": labels, "quantity": quantity, "paper": paper, **usual, **more}
    ours = value["ours"]
    known = ours is not None and paper and min(ours, paper) >= 0.0
    return {**value, "difference": ours / paper - 1.0 if known else None}


def make_table(
    name: str,
    title: str,
    keys: Sequence[str],
    values: Sequence[Entry],
    explanations: Mapping[str, str],
    *,
    measured: Sequence[Entry] = (),
    measured_title: str = "",
    all_in_title: str = "all simulations",
) -> Entry:
    """Return a table of a paper beside ours, with the explanations that its values have as reasons, or that these name.

    The name is unique in the record, `table2`; keys are heads of the labels, values are of `compare`. Below are rows
    that we alone have measured: `labels`, and `values` by quantity, the same ones in every row. A ValueError says that
    a row has other labels than the table, or that a reason is not explained.
    """
    for row in (*values, *measured):
        if len(row["labels"]) != len(keys):
            raise ValueError(f"Expected {len(keys)} labels ({', '.join(keys)}), got {row['labels']}.")
    used = {reason for value in values for reason in value["reasons"]}
    if unknown := used - explanations.keys():
        raise ValueError(f"No explanation {min(unknown)!r} in the table; known: {', '.join(explanations)}.")
    used |= {word for word in explanations if any(f"`{word}`" in explanations[each] for each in used)}
    return {
        "name": name,
        "title": title,
        "keys": keys,
        "values": values,
        "explanations": {word: text for word, text in explanations.items() if word in used},
        "measured": measured,
        "measured_title": measured_title,
        "all_in_title": all_in_title,
    }


def find(
    claim: str, statistic: str, verdict: str, value: float | None = None, interval: tuple[float, float] | None = None
) -> Entry:
    """Return a statement of a paper, and the statistic with its 95 % interval that says whether it is so here."""
    return {"claim": claim, "statistic": statistic, "value": value, "interval": interval, "verdict": verdict}


def make_record(settings: Mapping[str, Any], **content: Any) -> Entry:
    """Return a record as plain values for JSON.

    The settings are whatever the numbers depend on. The content has title, source and command; tables; figures, which
    have their data by names, with `caption` and `paper`: what they show, and what the printed ones show; findings;
    notes, which hold for all of it; and the single runs.
    """
    libraries = {name: find_version(name) for name in ("torch", "numba", "gymnasium")}
    made = about(rare_envs=rare_envs.__version__, **libraries, **settings)
    record: Entry = to_json_value({**content, "about": made})
    return record


def find_version(library: str) -> str:
    """Return the version of a library, which need not be installed."""
    try:
        return version(library)
    except PackageNotFoundError:
        return "not installed"


def write_record(out: Path, record: Mapping[str, Any], figures: Drawings) -> None:
    """Write a record as JSON and as Markdown, and its figures as PNG files, into a folder that exists."""
    (out / "reproduction.json").write_text(format_json(dict(record)) + "\n", encoding="utf-8")
    (out / "reproduction.md").write_text(format_record(record), encoding="utf-8")
    for name, (draw, size) in figures.items():
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        figure.savefig(out / f"{name}.png", dpi=150)


def check_folder(out: Path, study: Mapping[str, Any]) -> None:
    """Raise BadInput if a folder, which need not exist, has runs of another study, as their first lines say."""
    for file in sorted(out.glob("*.jsonl")):
        first, whole, _ = file.read_text(encoding="utf-8", errors="replace").partition("\n")
        try:
            held = dict(json.loads(first)["study"])
        except (ValueError, KeyError, TypeError):
            held = {}
        if whole and held != study:
            raise BadInput(
                f"{out} holds {_describe_study(held)}; this is {_describe_study(study)}: choose another --out."
            )


def _describe_study(study: Mapping[str, Any]) -> str:
    words = (str(value) if name == "paper" else f"{name} {value}" for name, value in study.items())
    return ", ".join(words) or "runs of another command or version"


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
            lines += [f"{table['measured_title']}:", "", format_table(heads, rows), ""]
        lines += [f"- *{name}*: {text}" for name, text in table["explanations"].items()]
    if record["findings"]:
        rows = [
            [row["claim"], row["statistic"], format_number(row["value"]), format_ends(row["interval"]), row["verdict"]]
            for row in record["findings"]
        ]
        lines += ["", "### Findings", ""]
        lines += [format_table(["statement", "statistic", "value", "95 % interval", "here"], rows)]
    lines += ["", "### Figures", ""] if record["figures"] else []
    lines += [
        f"- {each['title']} {each['caption']} In the paper: {each['paper']}" for each in record["figures"].values()
    ]
    return "\n".join(lines) + "\n"


def _format_compared(table: Mapping[str, Any]) -> Iterator[str]:
    """Return a table of a record as Markdown: a row a method with "paper / ours" by quantity, and notes below."""
    rows: dict[tuple[str, ...], dict[str, str]] = {}
    notes: list[str] = []
    for value in table["values"]:
        labels, (quantity, _, rests_on) = tuple(value["labels"]), str(value["quantity"]).partition(" (")
        cells = rows.setdefault(labels, {})
        cells[quantity] = _format_pair(value["paper"], value["ours"])
        cells[quantity] += f", {rests_on.rstrip(')')}" * bool(rests_on)  # events, say
        if value["interval"] is not None:
            cells[quantity] += f" ({format_ends(value['interval'])})"
        all_in = value["paper_all_in"], value["ours_all_in"]
        if all_in != (None, None):
            cells[f"{quantity}, {table['all_in_title']}"] = _format_pair(*all_in)
        said = [f"the released code: {value['released']}"] * bool(value["released"])
        said += [f"*{reason}*" for reason in value["reasons"]]
        notes += [f"- {', '.join(labels)}: {quantity}: {'; '.join(said)}"] * bool(said)
    heads = list(dict.fromkeys(head for cells in rows.values() for head in cells))
    body = [[*labels, *(cells.get(head, NOTHING) for head in heads)] for labels, cells in rows.items()]
    yield format_table([*table["keys"], *(f"{head}: paper / ours" for head in heads)], body)
    yield from ("", *notes) if notes else ()


def _format_pair(paper: float | None, ours: float | None) -> str:
    """Return a number of the paper beside ours."""
    return f"{format_number(paper)} / {format_number(ours)}"


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


def format_ends(interval: Sequence[float] | None) -> str:
    """Return the ends of an interval as text."""
    return NOTHING if interval is None else f"{format_number(interval[0])} to {format_number(interval[1])}"
