"""Model card of a folder of drivers, written from the headers of their files.

    python -m training.recipes.model_card agents/data

Writes README.md into the folder.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from agents import read_driver, read_provenance
from agents.files import holds_vision
from rare_envs.files import replace_text
from training.command_line import run_command

ATTRIBUTION = (
    "Derived from recorded trajectories of the Next Generation Simulation (NGSIM) programme: U.S. Department of "
    'Transportation, Federal Highway Administration, "Next Generation Simulation (NGSIM) Vehicle Trajectories and '
    'Supporting Data", open-data record 8ect-6jqj. Changes: trajectories were smoothed, cut into scenes and turned '
    "into weights of networks; no recorded trajectory is part of the files. FHWA neither made nor endorses them."
)
USE = (
    "**Use.** Background traffic and egos in the simulations of this project. They learned from a few minutes of dense "
    "traffic on one road (an ego that sees from pictures of this project's front camera, in imitation of a driver by "
    "rule), know nothing of other roads, weather, photographs, people on foot or traffic lights, and must not drive a "
    "car."
)
TRAFFIC = {
    "imitation": "The ego `imitation` was trained in these scenes, in draws of `CutIn-v0`, of `CarFollowing-v0` and of "
    "a `HardBrake-v0` whose lead braked at a constant rate, and in ordinary traffic, and corrected on failures in "
    "`CutIn-v0` and in the same script with a drawn duration; none of its cutters looked. `training/egos` of 8dec38c6 "
    "has the code of its commands.",
    "vision": "The ego `vision` was trained among scripted cutters, leads that swing, leads that brake at a constant "
    "rate, and in ordinary traffic, on roads and in weather that were drawn, and corrected on failures behind the "
    "third. `training/egos` of 8dec38c6 has the code of its commands.",
}
MEASURED = (
    "Both were measured in ordinary traffic (below, `benchmarks/driving/ordinary_traffic.py`), and in every scenario "
    "as it stands: p of a collision is in [docs/results.md](../../docs/results.md#egos)."
)
HEAD = (
    "Written by `python -m training.recipes.model_card` from the headers of the files. Load one with "
    '`agents.load_driver("NAME")`, an ego with `agents.load_ego("NAME")`.'
)


def format_model_card(folder: Path) -> str:
    """Return the card of all drivers, and egos that see, in a folder, as Markdown."""
    paths = sorted(folder.glob("*.safetensors"))
    if not paths:
        raise ValueError(f"Expected drivers (*.safetensors) in {str(folder)!r}, found none.")
    origins = {path.stem: read_provenance(path) for path in paths}
    facts = {path.stem: {"kind": origins[path.stem].kind, **_describe(path)} for path in paths}
    metrics = {name: dict(_flatten(origin.metrics)) for name, origin in origins.items()}
    ensembles = {name: dict(_flatten(origin.ensemble)) for name, origin in origins.items()}
    data = [
        f"{each.data.rstrip('.')}. Licence of the data and files: {each.data_licence}." for each in origins.values()
    ]
    egos = [TRAFFIC[name] for name in origins if name in TRAFFIC]
    commands = "\n".join(f"- {name}: `{origin.command}`" for name, origin in origins.items())
    parts = [
        *("# Learned drivers", HEAD, _table("", facts), USE),
        *("## Data and licence", *dict.fromkeys(data), ATTRIBUTION),
        *(("## Traffic of the egos", *egos, MEASURED) if egos else ()),
        *(
            "## Training",
            "By commands of the version of that time.",
            commands,
        ),
        *("## Metrics", _table("metric", metrics)),
        *("## Distribution of the last layer's weights", _table("", ensembles)),
    ]
    return "\n\n".join(parts) + "\n"


def _describe(path: Path) -> dict[str, str]:
    """Return noise, bounds and rules of a driver; nothing of a network that sees."""
    if holds_vision(path):
        return {}
    driver = read_driver(path)
    return {
        "noise, coefficients of lag 1": ", ".join(f"{value:.3g}" for value in driver.colour.first),
        "noise, coefficients of lag 2": ", ".join(f"{value:.3g}" for value in driver.colour.second),
        "acceleration [m/s^2]": f"{driver.acceleration[0]:g} to {driver.acceleration[1]:g}",
        "yaw rate [rad/s]": f"{driver.yaw_rate[0]:g} to {driver.yaw_rate[1]:g}",
        "rule of collision avoidance": "no" if driver.avoidance is None else "yes",
        "lane changes at a hazard rate": "no" if driver.changes is None else "yes",
        "distribution of the weights": "no" if driver.weights is None else "yes",
    }


def _table(corner: str, columns: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table with one column for each driver with values, and one row for everything that any of them has."""
    columns = {name: column for name, column in columns.items() if column}
    rows = dict.fromkeys(row for column in columns.values() for row in column)
    lines = [[corner, *columns], ["---"] * (len(columns) + 1)]
    for row in rows:
        values = ["" if column.get(row) is None else column[row] for column in columns.values()]
        texts = (f"{value:.4g}" if isinstance(value, float) else str(value) for value in values)
        lines.append([row, *(text.replace("|", "\\|") for text in texts)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield names and values of nested mappings, names joined by spaces; lists, which are long, are left out."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name} ")
        elif not isinstance(value, list):
            yield prefix + name, value


def main(folder: Annotated[Path, typer.Argument(help="Folder with the drivers.")]) -> None:
    """Write the model card of a folder of drivers."""
    replace_text(folder / "README.md", format_model_card(folder))


if __name__ == "__main__":
    run_command(main)
