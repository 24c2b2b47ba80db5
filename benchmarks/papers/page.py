"""Page of the documentation about papers, from the committed records of `python -m benchmarks.papers`.

    python -m benchmarks.papers.page

writes `docs/papers.md`. The records are `tian2024`, `okelly2018` (small scale), `okelly2018_full` and
`okelly2018_vision` in `benchmarks/results`: the `reproduction.json` of a run, under the name of its paper.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import RESULTS
from benchmarks.papers.markdown import format_reproduction
from benchmarks.papers.okelly2018.scales import CORE_SPEEDS, SEARCHES, STUDY_SCALES, StudyScale

PAPERS_PAGE = Path(__file__).parents[2] / "docs" / "papers.md"
PAPERS = ("tian2024", "okelly2018", "okelly2018_full", "okelly2018_vision")
READING = """\
import json
from collections.abc import Mapping
from pathlib import Path

import rare_envs

results = Path(rare_envs.__file__).parents[1] / "benchmarks" / "results"  # of a clone of the repository
record = json.loads((results / "tian2024.json").read_text())
for value in record["tables"][0]["values"]:
    if value["quantity"] == "gain over plain Monte Carlo":
        print(f"{value['labels'][0]}, {value['labels'][1]}: paper {value['paper']:.2g}, ours {value['ours']:.2g}")
"""
HEAD = """\
# Papers made anew

One command makes the tables and figures of a paper anew, beside those that were printed:

    python -m benchmarks.papers tian2024 --out tian2024 --scale small    # 5 replications; full: the paper's 20
    python -m benchmarks.papers okelly2018 --out okelly2018

Each writes `reproduction.md` (tables with a column of differences), figures in the paper's axes, and
`reproduction.json` (all numbers, the command, versions, machine and seeds, from which the page is made) and the single
runs, with which the same command goes on where it has ended. A folder holds one reproduction: another paper, ego, scale
or seed is refused. This page is made from the records in `benchmarks/results`; to read one:
"""

SCALES_HEAD = """\
## What was run, and what was not

| record | made | of | scale |
|---|---|---|---|
"""


def read_records() -> dict[str, dict[str, Any]]:
    """Return the committed records by paper."""
    files = {paper: RESULTS / f"{paper}.json" for paper in PAPERS}
    return {paper: json.loads(file.read_text(encoding="utf-8")) for paper, file in files.items() if file.exists()}


def format_scales(records: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table of what each record has of its scale, and what the full one would take with the vision ego."""
    rows = []
    for paper, record in records.items():
        if paper == "tian2024":
            replications = sum(len(runs["p"]) for runs in record["runs"])
            rows.append(f"| {record['title']} | {replications:,} replications | all | full: 20 of every method |")
            continue
        scale = StudyScale(**record["about"]["rollouts"])
        of = scale.naive + len(SEARCHES) * scale.per_search
        rows.append(
            f"| {record['title'].partition(',')[0]} | {record['runs'][0]['rollouts']:,} rollouts | {of:,} | "
            f"{record['about']['scale']} |"
        )
    lidar, vision = (CORE_SPEEDS[ego] for ego in ("lidar", "vision"))
    hours = [STUDY_SCALES["vision", scale].rollouts / vision / 3600 for scale in ("small", "full")]
    text = (
        "All is there but the full scale with the vision ego, which was not begun. In each rollout a camera draws a "
        "picture for each of 100 steps and a network looks at it: about "
        f"{vision:g} rollouts a second of a core's processor time (an AMD EPYC), where the lidar ego makes "
        f"{lidar:,.0f}. That is {hours[0]:.1f} core hours for the small scale and {hours[1]:.0f} for the full one; "
        "`python -m benchmarks.papers okelly2018 --ego vision --scale full --workers 64` is for a large machine. "
        "With this ego failures are so rare that the small scale's naive p rests on one event at most, so that it does "
        "not say whether cross-entropy gains what Table 2 and Figure 3 of the paper show; its draws fail often, "
        "with weights that add up to next to nothing, as with the lidar ego."
    )
    return SCALES_HEAD + "\n".join(rows) + f"\n\n{text}\n"


def format_papers_page() -> str:
    """Return the page as Markdown."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(READING, "reading of the page", "exec"), {})
    example = f"```python\n{READING}```\n\n```text\n{printed.getvalue()}```\n"
    records = read_records()
    return "\n".join([HEAD, example, format_scales(records), *map(format_reproduction, records.values())])


def main() -> None:
    """Write the page."""
    PAPERS_PAGE.write_text(format_papers_page(), encoding="utf-8")
    print(f"Wrote {PAPERS_PAGE}.")


if __name__ == "__main__":
    main()
