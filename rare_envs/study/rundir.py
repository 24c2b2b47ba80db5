"""The folder a run leaves behind: result.json, failures.csv, plot.png."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from rare_envs.study.evaluate import Report
from rare_envs.study.plots import save_plot

RESULT, FAILURES, PLOT = "result.json", "failures.csv", "plot.png"


def write_run(folder: Path, report: Report) -> None:
    """Write a report; numbers first, so that they are safe whatever happens to the picture.

    Args:
        folder: An existing folder; files of an earlier run in it are replaced.
        report: What to write.
    """
    text = json.dumps(report.to_dict(), indent=2, allow_nan=False)
    (folder / RESULT).write_text(text + "\n", encoding="utf-8")
    _write_failures(folder / FAILURES, report)
    save_plot(folder / PLOT, report)


def _write_failures(path: Path, report: Report) -> None:
    """One failure a row, the most likely first: its parameters by name, f and log p0."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*report.study.problem.space.names, "f", "log_p0"])
        # repr of a float gives it back exactly, so that a row replays to the same f
        writer.writerows([*failure.x.tolist(), failure.f, failure.log_p0] for failure in report.estimate.failures)
