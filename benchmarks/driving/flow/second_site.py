"""The drivers at a second site: windows of I-80 (Coifman and Li), of which none has seen anything.

    python -m benchmarks.driving.flow.second_site DATA [--noises 3] [--json FILE]

DATA is the folder with the table of I-80. The recording is cut into windows of 20 s, all vehicles but the first of each
lane are driven from every 2 s of each window for 10 and 20 s, and compared with the people. It has no positions across
the road and hardly any sizes: vehicles begin in the middle of their lane, 3.66 m wide, at their recorded lengths or the
recording's mean, and are 1.9 m wide. Its window is 84 m long, so few vehicles see another for long. Prints a
table and writes `benchmarks/results/second_site.json`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from agents import load_driver
from benchmarks import RESULTS
from benchmarks.driving.flow.recorded_flow import COIFMAN_FILE
from benchmarks.driving.realism import round_numbers, rule_driver
from benchmarks.driving.realism_rows import SECONDS, Effort, Judge, noisy_drivers
from rare_envs.threads import use_one_thread
from samplers.benchmark.runs import about
from training.data.formats.coifman_li import MEAN_LENGTH
from training.data.ngsim_tables import read_columns
from training.data.trajectories import NOBODY, tabulate
from training.data.windows import scenes_of
from training.imitation.evaluation.behaviour import Act
from training.imitation.evaluation.realism import record_statistics
from training.imitation.traffic.recording import Recording, stack_scenes

LANE_WIDTH, LANES = 3.66, 6
"""12 feet, the usual width [m]."""
WIDTH = 1.9
"""Assumed of all vehicles [m]."""
WINDOW = 20.0
"""Length of a window [s]."""
NAMES = ("mgail", "mgail2", "mgail3", "mgail4", "mgail5")


def read_windows(folder: Path, seconds: float = WINDOW) -> Recording:
    """Return the windows of I-80, each vehicle in the middle of the lane that it is first seen in.

    Args:
        folder: Folder with the table.
        seconds: Length of a window [s].
    """
    rows = read_columns(folder / COIFMAN_FILE, ("vehicle", "frame", "lane", "y_rear", "speed", "length"))
    rows = {name: values[np.isin(rows["lane"], range(1, LANES + 1))] for name, values in rows.items()}
    length = np.where(np.isfinite(rows["length"]), rows["length"], MEAN_LENGTH)
    # a vehicle that changes lanes is another one in its new lane: the record has no way between
    columns: dict[str, NDArray[Any] | str | float] = {
        "recording": "i80",
        "vehicle": (LANES + 1) * rows["vehicle"] + rows["lane"],
        "frame": rows["frame"],
        "x": rows["y_rear"] + 0.5 * length,
        "y": LANE_WIDTH * (rows["lane"] - 0.5),
        "speed": rows["speed"],
        "acceleration": np.nan,
        "length": length,
        "width": WIDTH,
        "lane": rows["lane"],
        "leader": NOBODY,
    }
    edges = tuple(LANE_WIDTH * number for number in range(LANES + 1))
    return stack_scenes(scenes_of(tabulate(columns, edges={"i80": edges}), seconds))


def measure_site(windows: Recording, drivers: dict[str, list[Act]]) -> dict[str, Any]:
    """Return the realism of drivers from every 2 s of every window."""
    judge = Judge(windows, record_statistics(windows), Effort())
    rows = {"people": judge.figures({time: [judge.recorded] for time in SECONDS})}
    rows |= {name: judge.row(name, "driver", acts) for name, acts in drivers.items()}
    for row in rows.values():
        del row["shares"]
    return rows


def format_site(rows: dict[str, Any]) -> str:
    """Return a table in Markdown."""
    names = ("vehicles", "collision", "off_road", "hard_brake", "lane_changes", "mean_speed")
    lines = [f"| 10 s / 20 s | {' | '.join(names)} | position after 5 s, m |", "|" + "---|" * (len(names) + 2)]
    for name, row in rows.items():
        first, last = (row[f"{seconds:g} s"] for seconds in SECONDS)
        cells = [f"{first[key]:.4g} / {last[key]:.4g}" for key in names]
        lines.append(f"| {name} | {' | '.join(cells)} | {first['rmse'].get('position', float('nan')):.2f} |")
    return "\n".join(lines)


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the table of I-80.")],
    noises: Annotated[int, typer.Option(help="Sequences of noise of each driver.")] = Effort.noises,
    result: Annotated[Path, typer.Option("--json", help="File for the result.")] = RESULTS / "second_site.json",
) -> None:
    """Measure, print the table and write the result."""
    drivers: dict[str, list[Act]] = {"IDM, lane keeping": [rule_driver]}
    for name in NAMES:
        driver: Any = load_driver(name)
        drivers[name] = noisy_drivers(driver, noises)
    rows = measure_site(read_windows(data), drivers)
    about_run = about(
        torch=torch.__version__, command="python -m benchmarks.driving.flow.second_site DATA", noises=noises
    )
    text = json.dumps(round_numbers({"rows": rows, "about": about_run}), indent=1)
    result.write_text(text + "\n", encoding="utf-8")
    print(format_site(rows))


if __name__ == "__main__":
    typer.run(main)
