"""Command line of imitation training.

    python -m training.imitation --data FOLDER --method mgail --seed 0 --out runs/mgail
    python -m training.imitation --highd FOLDER --recording 01 --out runs/highd

Writes into the folder `driver.safetensors` (see `agents.load_driver`), `training.json` (source and settings) and a
checkpoint. The same command on the same folder takes up a training that was stopped, to the same weights.
"""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
from dataclasses import dataclass
from typing import Annotated

import typer

from rare_envs.startup import use_one_thread
from training.command_line import (
    LocationOption,
    RecordingOptions,
    RunFolderOption,
    report_errors,
    run_command,
    spread_options,
)
from training.imitation.config import Config
from training.imitation.train import Source, train_driver


@dataclass(frozen=True, kw_only=True)
class SourceOptions(RecordingOptions):
    """Options that name the source of recorded scenes."""

    location: LocationOption = None
    recording: Annotated[list[str] | None, typer.Option(help="Recording of highD, such as 01; may be repeated.")] = None
    seconds: Annotated[float, typer.Option(help="Length of the scenes of such files in seconds.")] = Source.seconds


@spread_options
@use_one_thread()
def main(
    out: RunFolderOption,
    recordings: SourceOptions,
    config: Config,
    device: Annotated[str, typer.Option(help="Device that trains: cpu, or a GPU (cuda, cuda:1).")] = "cpu",
    log: Annotated[bool, typer.Option("--log", help="Write TensorBoard logs into the folder.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Train a driver model of surrounding vehicles from recorded traffic, for estimate --drivers.

    Example: python -m training.imitation --highd path/to/highD/data --method gail --out runs/drivers
    """
    with report_errors("training.imitation"):
        kind, path = recordings.kind_and_path()
        source = Source(kind, path, recordings.location, tuple(recordings.recording or ()), recordings.seconds)
        with contextlib.redirect_stdout(sys.stderr if as_json else sys.stdout):
            driver = train_driver(source, config, out, log=log, progress=True, device=device)
    if as_json:
        print(json.dumps({"driver": str(driver), "method": config.method, "seed": config.seed}, indent=2))
    else:
        print(f"Saved {driver}. Next: rare-envs estimate SCENARIO --drivers {shlex.quote(str(driver))}")


if __name__ == "__main__":
    run_command(main)
