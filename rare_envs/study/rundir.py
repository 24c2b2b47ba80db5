"""The folder a run leaves behind: result.json, failures.csv, plot.png."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

from rare_envs.study.columns import columns_of
from rare_envs.study.evaluate import Report
from rare_envs.study.plots import save_plot

RESULT, FAILURES, PLOT = "result.json", "failures.csv", "plot.png"


def write_run(folder: Path, report: Report) -> None:
    """Write a report; numbers first, so that they are safe whatever happens to the picture.

    Args:
        folder: An existing folder; files of an earlier run in it are replaced.
        report: What to write.
    """
    (folder / RESULT).write_text(to_text(report.to_dict()) + "\n", encoding="utf-8")
    _write_failures(folder / FAILURES, report)
    save_plot(folder / PLOT, report)


def to_text(value: dict[str, Any]) -> str:
    """JSON with one entry a line, but lists of numbers in one, however long."""
    text = json.dumps(value, indent=2, allow_nan=False)
    # a line that ends with a bracket is no part of a string, which would have no line breaks
    return re.sub(r"\[\n([^\[\]{}\"]*)\n *\]", lambda found: f"[{' '.join(found[1].split())}]", text)


def _write_failures(path: Path, report: Report) -> None:
    """One failure a row, the most likely first: the columns of its x by name, f and log p0."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*(column.name for column in columns_of(report.study.problem.space)), "f", "log_p0"])
        # repr of a float gives it back exactly, so that a row replays to the same f
        writer.writerows([*failure.x.tolist(), failure.f, failure.log_p0] for failure in report.estimate.failures)
