"""The drivers `gail` and `mgail`: trained on US 101, each with the distribution of its last layer's weights.

    python -m training.recipes.drivers mgail --data TABLES --out runs/mgail

TABLES is the folder with the compact tables of US 101. The rules beside the network of the shipped `mgail` (a noise of
the acceleration damped at 0.2 /s, avoidance, lane changes that wait for a gap) are settings of `agents.load_driver`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from rare_envs.startup import use_one_thread
from training.command_line import RunFolderOption, report_errors, run_command
from training.imitation.config import Config
from training.imitation.train import Source, train_driver
from training.imitation.weights import Ensemble, make_ensemble

CONFIGS = {
    "gail": Config(method="gail", updates=1100, horizon=(40, 40), critic_weight=4.5, brake_weight=2.0),
    "mgail": Config(method="mgail", updates=1500),
}
ENSEMBLES = {"gail": Ensemble(members=32, updates=30), "mgail": Ensemble(members=32, updates=60)}


@use_one_thread()
def main(
    name: Annotated[Literal["gail", "mgail"], typer.Argument(help="Which driver.")],
    data: Annotated[Path, typer.Option(help="Folder with the compact tables of US 101.")],
    out: RunFolderOption,
) -> None:
    """Train a driver and an ensemble around it; both are taken up where they were stopped."""
    with report_errors("drivers"):
        train_driver(Source("data", data), CONFIGS[name], out, progress=True)
        path = make_ensemble(out, ENSEMBLES[name], out / f"{name}.safetensors", progress=True)
    print(f"Saved {path}.")


if __name__ == "__main__":
    run_command(main)
