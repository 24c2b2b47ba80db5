"""Model card of a folder of drivers, written from the headers of their files.

    python -m training.recipes.model_card agents/data

Writes README.md into the folder.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from agents import LearnedDriver, Provenance, read_driver, read_provenance
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
    "Background traffic and egos in the simulations of this project. They learned from a few minutes of dense "
    "traffic on one road, know nothing of other roads, weather, people on foot or traffic lights, and must not drive a "
    "car."
)
VISION_USE = (
    "PilotNet on pictures of the front camera of this project, the own speed beside them, in imitation of a driver by "
    "rule. It knows no photographs, no other camera, no crossings and no people on foot, and must not drive a car."
)


def format_model_card(folder: Path) -> str:
    """Return the card of all drivers, and egos that see, in a folder, as Markdown."""
    files = sorted(folder.glob("*.safetensors"))
    seeing = [path for path in files if holds_vision(path)]
    paths = [path for path in files if path not in seeing]
    if not paths:
        raise ValueError(f"Expected drivers (*.safetensors) in {str(folder)!r}, found none.")
    drivers = {path.stem: (read_driver(path), read_provenance(path)) for path in paths}
    metrics = {name: dict(_flatten(provenance.metrics)) for name, (_, provenance) in drivers.items()}
    ensembles = {name: dict(_flatten(provenance.ensemble)) for name, (_, provenance) in drivers.items()}
    parts = [
        "# Learned drivers",
        "Written by `python -m training.recipes.model_card` from the headers of the files. "
        'Load one with `agents.load_driver("NAME")`.',
        _drivers_table(drivers),
        f"**Use.** {USE}",
        "## Data and licence",
        *dict.fromkeys(
            f"{provenance.data.rstrip('.')}. Licence of the data and of these files: {provenance.data_licence}."
            for _, provenance in drivers.values()
        ),
        ATTRIBUTION,
        "## Training",
        "By commands of the version of that time; those of today are in `training/recipes`.",
        "\n".join(f"- {name}: `{provenance.command}`" for name, (_, provenance) in drivers.items()),
        *(["## Metrics", _table("metric", metrics)] if any(metrics.values()) else []),
        *(["## Distribution of the last layer's weights", _table("", ensembles)] if any(ensembles.values()) else []),
        *(part for path in seeing for part in _vision_sections(path)),
    ]
    return "\n\n".join(parts) + "\n"


def _vision_sections(path: Path) -> Iterator[str]:
    """Yield the sections on a network that drives by pictures."""
    provenance = read_provenance(path)
    yield f"## {path.stem}, an ego that sees"
    yield f'{VISION_USE} Load it with `agents.load_ego("{path.stem}")`.'
    yield f"**Data.** {provenance.data} Licence of the file: {provenance.data_licence}."
    yield f"**Training.** {provenance.kind}, by `{provenance.command}`."
    if provenance.metrics:
        yield _table("case", {name: dict(_flatten(values)) for name, values in provenance.metrics.items()})


def _drivers_table(drivers: Mapping[str, tuple[LearnedDriver, Provenance]]) -> str:
    """Return a table of kinds, noises and bounds."""
    columns = {
        name: {
            "kind": provenance.kind,
            "noise, coefficients of lag 1": ", ".join(f"{value:.3g}" for value in driver.colour.first),
            "noise, coefficients of lag 2": ", ".join(f"{value:.3g}" for value in driver.colour.second),
            "acceleration [m/s^2]": f"{driver.acceleration[0]:g} to {driver.acceleration[1]:g}",
            "yaw rate [rad/s]": f"{driver.yaw_rate[0]:g} to {driver.yaw_rate[1]:g}",
            "rule of collision avoidance": "no" if driver.avoidance is None else "yes",
            "lane changes at a hazard rate": "no" if driver.changes is None else "yes",
            "distribution of the weights": "no" if driver.weights is None else "yes",
        }
        for name, (driver, provenance) in drivers.items()
    }
    return _table("", columns)


def _table(corner: str, columns: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table with one column for each driver and one row for everything that any of them has."""
    rows = dict.fromkeys(row for column in columns.values() for row in column)
    lines = [[corner, *columns], ["---"] * (len(columns) + 1)]
    lines += [[row, *(_cell(column.get(row)) for column in columns.values())] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield names and values of nested mappings, names joined by spaces; lists, which are long, are left out."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name} ")
        elif not isinstance(value, list):
            yield prefix + name, value


def _cell(value: Any) -> str:
    """Return a value as the text of a cell."""
    text = "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
    return text.replace("|", "\\|")


def main(folder: Annotated[Path, typer.Argument(help="Folder with the drivers.")]) -> None:
    """Write the model card of a folder of drivers."""
    replace_text(folder / "README.md", format_model_card(folder))


if __name__ == "__main__":
    run_command(main)
