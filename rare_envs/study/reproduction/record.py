"""Record of a reproduction: a JSON file with the numbers and what made them, from which every page is made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import rare_envs
from rare_envs.files import replace_text
from rare_envs.json_text import format_json
from rare_envs.study.html_report.svg import FigureOfPage
from rare_envs.study.reproduction.comparison import ComparisonTable, TestedClaim
from rare_envs.study.reproduction.page import render_reproduction
from samplers.benchmark.runs import about
from samplers.serialization import to_json_value

REPRODUCTION_FILE, REPRODUCTION_PAGE = "reproduction.json", "reproduction.html"
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


def write_record(out: Path, record: Mapping[str, Any], figures: Sequence[FigureOfPage]) -> list[Path]:
    """Write a record and its page.

    Args:
        out: Folder, which exists.
        record: As `make_record` returns it.
        figures: Drawn from the record, each with the name that its data have there.

    Returns:
        The JSON file and the page.
    """
    paths = [out / REPRODUCTION_FILE, out / REPRODUCTION_PAGE]
    replace_text(paths[0], format_json(dict(record)) + "\n")
    replace_text(paths[1], render_reproduction(record, figures))
    return paths


def _library_versions() -> dict[str, str]:
    found = {}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
