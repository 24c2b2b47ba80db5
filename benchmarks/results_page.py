"""Page of results, from the committed records: `python -m benchmarks.results_page` writes `docs/results.md`.

Every table names the command that made its record; the records in `benchmarks/results` have more than the page shows.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks import RESULTS, format_table

PAGE = Path(__file__).parents[1] / "docs" / "results.md"
HEAD = """\
# Results

What was measured, section by section: the question, the command that answers it, the figures. All are of November 2026
and version 0.1.0. `python -m benchmarks.results_page` writes this page from the JSON records in `benchmarks/results`,
which have more than it shows. To read one:

```python
import json
from pathlib import Path

import rare_envs

clone = Path(rare_envs.__file__).parents[1]  # of the repository
record = json.loads((clone / "benchmarks/results/truth.json").read_text())
for row in record["results"]:
    env, n = row["env_id"].partition("/")[2], row["rollouts"] // 10**6
    print(f"{env}, {row['base']}: {row['p']:.2e} by {n} million")
```

```text
CarFollowing-v0, us101-gap: 1.22e-04 by 300 million
CarFollowing-v0, highway: 2.58e-04 by 300 million
CutIn-v0, us101-15-offsets: 7.82e-04 by 300 million
CutIn-v0, highway: 3.07e-04 by 300 million
```

These are collision probabilities of the rule-based ego by plain rollouts, the truth of the first section. Words of the
tables:

- *mean / p*: mean of the estimates over the seeds, divided by the true probability.
- *coverage*: share of the runs whose 95 % interval covers p.
- *c.o.v. (own)*: relative standard error over the seeds, and (the one that the runs state).
- *gain*: how many times as many simulations plain Monte Carlo needs for the same mean square error.
"""
SHOWN_PAPERS = ("tian2024", "okelly2018_full", "okelly2018_vision")
SHOWN_STATES = 10
"""Limit states with the least gains that the page shows; the record has all."""
COMPARED = ("mean of p", "gain over plain Monte Carlo", "p (")
"""Quantities of a paper's tables that the page shows, by their beginnings."""


def read(name: str) -> dict[str, Any]:
    """Return a committed record."""
    record: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return record


def name_of(env_id: str) -> str:
    """Return an environment's id without its namespace."""
    return env_id.removeprefix("rare_envs/")


def format_traffic() -> Iterator[str]:
    """Yield the section of methods in traffic."""
    record = read("against_truth")
    yield "## Methods in traffic\n\nDo the methods find the true probability of a collision, and at what cost?"
    yield f"40 runs of each, against the 300 million rollouts above: `{record['command']}`.\n"
    heads = ("scenario, base", "method", "mean / p", "coverage", "c.o.v. (own)", "simulations", "gain")
    yield format_table(
        heads,
        (
            (
                f"{name_of(cell['env_id'])}, {cell['base']}",
                f"`{cell['method']}`",
                f"{cell['mean'] / cell['truth']:.3f}",
                f"{cell['coverage']:.0%}",
                _format_cov(cell),
                f"{cell['n_sim']:,.0f}",
                f"{cell['gain']:,.3g}",
            )
            for cell in record["cells"]
            if cell["method"] != "auto"
        ),
    )


def format_samplers() -> Iterator[str]:
    """Yield the section of methods where p is known, side by side."""
    record = read("samplers")
    yield "## Methods where p is known\n\nDo they find exact probabilities of problems without cars, and warn if not?"
    yield f"`{record['about']['command']}`. A run is *far* if it is off by more than 4 of its own standard errors,"
    yield "and *wrong* if far or if its interval misses p; 95 % intervals follow the shares.\n"
    (tables,) = record["tables"]
    yield format_table(*tables["methods"])
    yield "\nGains (coverage in %) where the first covers or gains least, or another gains **twice as much**:\n"
    heads, rows = tables["problems"]
    yield format_table(heads, (row for k, row in enumerate(rows) if k < SHOWN_STATES or "**" in "".join(row)))


def format_strata() -> Iterator[str]:
    """Yield the section of sums over strata."""
    record = read("strata")
    yield "## Sums over strata\n\nWhat is gained by a run for each kind of event (`auto`)?"
    yield "Half-spaces in strata of very different size:"
    yield f"`{record['about']['command']}`.\n"
    for tables in record["tables"]:
        yield f"Gains (coverage in %) with {tables['budget']:,} simulations:\n"
        yield format_table(*tables["problems"])
        yield ""


def _format_cov(row: Mapping[str, Any]) -> str:
    """Return the spread over seeds and what runs state, an en dash where a run does not know it."""
    shown = ["–" if row[key] is None else f"{row[key]:.3f}" for key in ("cov", "own_cov")]
    return f"{shown[0]} ({shown[1]})"


def format_stopping() -> Iterator[str]:
    """Yield the section of runs that stop on what they see."""
    record = read("stopping")
    yield "## Runs to a target\n\nDoes an interval still cover p if the run stops on what it saw?"
    yield "Coverage at the stop, and of the sequence at all looks, without what a search may have missed."
    yield "*Gate*: wrong passes at a limit just below p,"
    yield f"wrong failures just above, undecided at 0.8 p and 1.25 p (by the interval). `{record['command']}`\n"
    yield format_table(
        ("problem", "p", "method, c.o.v.", "interval", "sequence", "at all looks", "times as wide", "gate"),
        (
            (
                case["name"],
                f"{case['p']:.1e}",
                f"`{case['method']}`, {case['target_cov']:g}",
                *("–" if case[key] is None else f"{case[key]:.1%}" for key in ("interval", "sequence", "looks")),
                f"{case['width']:.2f}",
                " / ".join(f"{now:.0%} ({before:.0%})" for now, before in zip(*_read_gates(case), strict=True)),
            )
            for case in record["cases"]
        ),
    )


def _read_gates(case: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    """Return what the gate said by the sequence, and by the interval."""
    return list(case["gate"].values()), list(case["gate_by_interval"].values())


def format_bases() -> Iterator[str]:
    """Yield the section of intervals from refits."""
    record = read("recipe_coverage")
    yield "## Intervals of the base distribution\n\nDo the intervals from refits to few recorded events cover p?"
    yield f"In worlds with known p; coordinates and components are chosen in each refit: `{record['command']}`.\n"
    yield format_table(
        ("world", "draws", "covers p", "wholly below p", "upper limit only", "sampling interval covers p"),
        (
            (
                f"{world['name']}, {world['events']} events",
                str(world["repetitions"]),
                *(f"{world[key]:.0%}" for key in ("covered", "below", "undetermined", "sampling_covered")),
            )
            for world in record["worlds"]
        ),
    )


def format_egos(ids: frozenset[str]) -> Iterator[str]:
    """Yield the section of the egos.

    Args:
        ids: Environments that there are.
    """
    record = read("egos")
    yield "## Egos\n\nHow often do the shipped and some trained egos crash? p of a collision within 10 s,"
    yield "and in each kind of event, by the default method, `auto`, or by plain draws, `mc`; intervals of simulation"
    yield f"alone. `ppo` and `dqn` are trained in the scenario, as `train-ego` does: `{record['command']}`.\n"
    cells = [cell for cell in record["cells"] if cell["env_id"] in ids]
    yield format_table(
        ("scenario", "ego", "by", "p", "95 % interval", "strata", "warnings", "likeliest crash"),
        (
            (
                name_of(cell["env_id"]),
                f"`{cell['ego']}`" + (f", {cell['steps']:,} steps" if cell["steps"] else ""),
                f"`{cell['method']}`",
                f"{cell['p']:.1e}" if cell["p"] else "0",
                f"{cell['low']:.1e} to {cell['high']:.1e}" if cell["low"] else f"below {cell['high']:.1e}",
                ", ".join(
                    f"{name} {f'{p:.1e}' if resolved else f'below {high:.1e}'}"
                    for name, (p, _, high, resolved) in cell["parts"].items()
                ),
                str(len(cell["warnings"])),
                cell["words"],
            )
            for cell in cells
        ),
    )


def format_papers() -> Iterator[str]:
    """Yield the section of both papers: p and gains; the records have every row."""
    yield "## Papers\n\nAre the tables of Tian et al. (2024) and O'Kelly et al. (2018) reproduced?"
    yield "Every row and the reasons for differences are in the records, and in `reproduction.md` of"
    yield "`python -m benchmarks.papers`.\n"
    for name in SHOWN_PAPERS:
        record = read(name)
        yield f"\n`{record['command']}`\n"
        rows = [row for table in record["tables"] for row in _compare(table["values"])]
        width = max(map(len, rows))
        yield format_table(
            ("row", "of", "p, paper", "p, ours", "gain, paper", "gain, ours")[:width],
            (row + ("",) * (width - len(row)) for row in rows),
        )


def _compare(values: Iterable[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return a row for each method of a paper's table: labels, p and, where the paper has it, gain."""
    rows: dict[tuple[str, ...], tuple[str, ...]] = {}
    for value in values:
        if value["quantity"].startswith(COMPARED) and None not in (value["paper"], value["ours"]):
            labels = tuple(value["labels"])
            rows[labels] = (*rows.get(labels, labels), _number(value["paper"]), _number(value["ours"]))
    return list(rows.values())


def _number(value: float) -> str:
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1000 else f"{value:,.0f}" if value >= 1000 else f"{value:.2e}"


def format_speed() -> Iterator[str]:
    """Yield the section of speed."""
    record = read("throughput")
    yield "## Speed\n\nHow many times as fast as HighwayEnv's own objects is the simulation, in one process?"
    yield "`make bench`"
    yield f"({record['machine']['processor']}, one core).\n"
    yield format_ratios(record["results"])
    yield (
        "\nBeside EnvPool's HighwayEnv, which is C++: two cars, 1,024 episodes at once, stepped (a meta-action"
        "\neach second, or an action each tick of 0.1 s), or driven by a policy of two layers of 64.\n"
    )
    yield format_ratios(read("envpool")["results"])


def format_ratios(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Return a table of speeds."""
    return format_table(
        ("what", "times as fast", "least to most"),
        (
            (key.replace("_", " "), f"{row['ratio']:,.3g}", f"{row['ratio_min']:,.3g} to {row['ratio_max']:,.3g}")
            for key, row in rows.items()
            if "ratio_min" in row
        ),
    )


def format_page() -> str:
    """Return the page as Markdown."""
    import rare_envs

    sections = (
        format_traffic(),
        format_samplers(),
        format_strata(),
        format_stopping(),
        format_bases(),
        format_egos(frozenset(rare_envs.ENV_IDS)),
        format_papers(),
        format_speed(),
    )
    return "\n".join([HEAD, *("\n".join(section) + "\n" for section in sections)])


def main() -> None:
    """Write the page."""
    PAGE.write_text(format_page(), encoding="utf-8")
    print(f"Wrote {PAGE}.")


if __name__ == "__main__":
    main()
