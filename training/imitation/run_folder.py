"""Trainings in folders: from recorded files to a driver's file.

A folder holds `driver.safetensors` (see `agents.load_driver`), `training.json` (source and settings) and a checkpoint,
from which a training that was stopped goes on to the same weights.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from agents import LearnedDriver, Provenance, save_driver
from agents.learned.coloured_noise import WHITE_NOISE, AutoregressiveNoise
from agents.learned.networks import Policy
from training.imitation.algorithms.actions import ACTION_HIGH, ACTION_LOW
from training.imitation.algorithms.config import HUMAN_NOISE, Config
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.realism import header_metrics
from training.imitation.fit import CHECKPOINT, make_learner, prepare_data, train_learner
from training.imitation.progress import summary_writer

DRIVER, SETTINGS = "driver.safetensors", "training.json"
"""What a training leaves in its folder beside the checkpoint."""
NOISES = {"human": HUMAN_NOISE, "white": WHITE_NOISE}
"""Names of noises on the command line."""


def train_driver(
    source: Source, config: Config, out: Path, *, log: bool = False, progress: bool = False, measured: bool = True
) -> Path:
    """Train a driver from files, from the first update or from where a training in the folder was stopped.

    Args:
        source: Recorded traffic.
        config: Settings.
        out: Folder; it is made if there is none.
        log: Write TensorBoard logs there.
        progress: Show a bar on standard error.
        measured: Measure the driver in the scenes kept for tests, for the header of its file.

    Returns:
        The driver's file.

    Raises:
        ValueError: If the data cannot be read, the folder holds another training, or logs are asked for and
            TensorBoard is not installed.
    """
    if log:
        summary_writer()
    settings = format_settings(source, config)
    check_folder(out, settings)
    data = prepare_data(*load_scenes(source))
    write_settings(out, settings)
    policy = train_learner(make_learner(data, config), out, log, progress)
    driver = driver_of(policy, config)
    provenance = Provenance(
        kind=config.method,
        command=command_of(source, config),
        data=source.description,
        data_licence=source.licence,
        metrics=header_metrics(data.test, driver) if measured and data.test is not None else {},
    )
    return save_driver(driver, provenance, out / DRIVER)


def driver_of(policy: Policy, config: Config) -> LearnedDriver:
    """The driver that a trained policy is, with the noise and the limits that it was trained with."""
    frozen = policy.eval().requires_grad_(False)
    acceleration, yaw_rate = zip(ACTION_LOW, ACTION_HIGH, strict=True)
    return LearnedDriver(frozen, config.colour, acceleration, yaw_rate, name=config.method)


def command_of(source: Source, config: Config) -> str:
    """The command that repeats a training, but for the folders."""
    words = []
    for option in fields(Config):
        value = getattr(config, option.name)
        if option.name in ("method", "seed") or value != option.default:
            words += _option(option.name, value)
    return f"python -m training.imitation.train {source.options} {shlex.join(words)}"


def _option(name: str, value: Any) -> list[str]:
    if isinstance(value, AutoregressiveNoise):
        named = [word for word, colour in NOISES.items() if colour == value]
        return ["--noise", *named] if named else []
    flag = "--" + name.replace("_", "-")
    if isinstance(value, bool):
        return [flag] if value else [flag.replace("--", "--no-")]
    return [flag, *(str(part) for part in (value if isinstance(value, tuple) else (value,)))]


def format_settings(source: Source, config: Config) -> str:
    """Source and settings as JSON."""
    return json.dumps({"source": {**asdict(source), "path": str(source.path)}, "config": asdict(config)}, indent=1)


def check_folder(out: Path, settings: str) -> None:
    """Refuse a folder for a training.

    Raises:
        ValueError: If it is a file, or holds a training with other settings.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"Expected a folder for the training, got the file {str(out)!r}.")
    begun = any((out / name).exists() for name in (CHECKPOINT, DRIVER))
    noted = out / SETTINGS
    if begun and noted.exists() and json.loads(noted.read_text(encoding="utf-8")) != json.loads(settings):
        raise ValueError(f"{str(out)!r} holds a training with other settings; choose another folder or remove it.")


def write_settings(out: Path, settings: str) -> None:
    """Write settings into a folder, which is made if there is none.

    Raises:
        ValueError: If it cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"Cannot make the folder {str(out)!r}: {error}.") from None
    (out / SETTINGS).write_text(settings + "\n", encoding="utf-8")


def read_training_settings(folder: Path) -> tuple[Source, Config]:
    """Source and settings of the training in a folder.

    Raises:
        ValueError: If there is none.
    """
    path = folder / SETTINGS
    if not path.is_file():
        raise ValueError(f"Expected a training in {str(folder)!r}, but there is no {SETTINGS}.")
    noted = json.loads(path.read_text(encoding="utf-8"))
    source, config = noted["source"], {name: _tuples(value) for name, value in noted["config"].items()}
    config["colour"] = AutoregressiveNoise(**{name: tuple(value) for name, value in noted["config"]["colour"].items()})
    return replace(
        Source(source["kind"], Path(source["path"])),
        **{name: _tuples(source[name]) for name in ("location", "recordings", "seconds")},
    ), Config(**config)


def _tuples(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
