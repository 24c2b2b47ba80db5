"""Folders of trainings: from recorded files to the file of a driver.

A folder holds `driver.safetensors` (see `agents.load_driver`), `training.json` (source and settings) and a checkpoint,
from which a stopped training is resumed to the same weights.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from agents import LearnedDriver, Provenance, save_driver
from agents.learned.coloured_noise import HUMAN_NOISE, WHITE_NOISE, AutoregressiveNoise
from agents.learned.networks import Policy
from rare_envs.devices import find_device
from rare_envs.files import replace_text
from training.imitation.algorithms.actions import ACTION_HIGH, ACTION_LOW
from training.imitation.algorithms.config import Config
from training.imitation.datasets import Source, load_scenes
from training.imitation.evaluation.realism import header_metrics
from training.imitation.fit import CHECKPOINT, make_learner, prepare_data, train_learner
from training.imitation.progress import summary_writer

DRIVER, SETTINGS_FILE = "driver.safetensors", "training.json"
"""Names of the files in the folder of a training, beside the checkpoint."""
NOISES = {"human": HUMAN_NOISE, "white": WHITE_NOISE}
"""Noises by their names on the command line."""


def train_driver(
    source: Source,
    config: Config,
    out: Path,
    *,
    log: bool = False,
    progress: bool = False,
    measured: bool = True,
    device: str = "cpu",
) -> Path:
    """Train a driver from files, from the first update or from where a training in the folder was stopped.

    Args:
        source: Recorded traffic.
        config: Settings.
        out: Folder; it is made if there is none.
        log: Write TensorBoard logs to it.
        progress: Show a bar on standard error.
        measured: Measure the driver in the scenes kept for tests, for the header of its file.
        device: Where it is trained: "cpu", or a GPU, such as "cuda". Weights differ by rounding that grows with the
            updates; what is drawn is the same.

    Returns:
        The file of the driver.

    Raises:
        ValueError: The data cannot be read, the folder holds another training, or logs are to be written and
            TensorBoard is not installed.

    Example:
        >>> train_driver(Source("data", Path("no_such_folder")), Config(), Path("out"))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: There is no ngsim_us101_scenes.parquet in the folder 'no_such_folder'. ...
    """
    if log:
        summary_writer()
    place = find_device(device)
    settings = format_settings(source, config)
    check_folder(out, settings)
    data = prepare_data(*load_scenes(source))
    write_settings(out, settings)
    policy = train_learner(make_learner(data, config, device=place), out, log, progress)
    driver = driver_of(policy.cpu(), config)
    provenance = Provenance(
        kind=config.method,
        command=command_of(source, config, device),
        data=source.description,
        data_licence=source.licence,
        metrics=header_metrics(data.test, driver) if measured and data.test is not None else {},
    )
    return save_driver(driver, provenance, out / DRIVER)


def driver_of(policy: Policy, config: Config) -> LearnedDriver:
    """Return the driver of a trained policy, with the noise and the bounds of actions that it was trained with.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> config = Config(updates=1, epochs=1, scenes=2, warm_up=0)
        >>> driver = driver_of(train_learner(make_learner(data, config)), config)
        >>> driver.name, driver.acceleration
        ('mgail', (-8.0, 4.0))
    """
    frozen = policy.eval().requires_grad_(False)
    acceleration, yaw_rate = zip(ACTION_LOW, ACTION_HIGH, strict=True)
    return LearnedDriver(frozen, config.colour, acceleration, yaw_rate, name=config.method)


def command_of(source: Source, config: Config, device: str = "cpu") -> str:
    """Return the command that repeats a training on a device, without its folders."""
    words = []
    for option in fields(Config):
        value = getattr(config, option.name)  # a field by its name
        if option.name in ("method", "seed") or value != option.default:
            words += _option(option.name, value)
    words += [] if device == "cpu" else ["--device", device]
    return f"python -m training.imitation.train {source.options} {shlex.join(words)}"


def _option(name: str, value: Any) -> list[str]:
    """Return a setting as words of the command line."""
    if isinstance(value, AutoregressiveNoise):
        named = [word for word, colour in NOISES.items() if colour == value]
        return ["--noise", *named] if named else []
    flag = "--" + name.replace("_", "-")
    return [flag, *(str(part) for part in (value if isinstance(value, tuple) else (value,)))]


def format_settings(source: Source, config: Config) -> str:
    """Return source and settings as JSON."""
    return json.dumps({"source": {**asdict(source), "path": str(source.path)}, "config": asdict(config)}, indent=1)


def check_folder(out: Path, settings: str) -> None:
    """Check that a folder can take a training.

    Raises:
        ValueError: It is a file, or holds a training with other settings.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"Expected a folder for the training, got the file {str(out)!r}.")
    begun = any((out / name).exists() for name in (CHECKPOINT, DRIVER))
    noted = out / SETTINGS_FILE
    if begun and noted.exists() and json.loads(noted.read_text(encoding="utf-8")) != json.loads(settings):
        raise ValueError(f"{str(out)!r} holds a training with other settings; choose another folder or remove it.")


def write_settings(out: Path, settings: str) -> None:
    """Write settings to a folder, which is made if there is none.

    Raises:
        ValueError: It cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"Cannot make the folder {str(out)!r}: {error}.") from None
    replace_text(out / SETTINGS_FILE, settings + "\n")


def read_training_settings(folder: Path) -> tuple[Source, Config]:
    """Return source and settings of the training in a folder.

    Raises:
        ValueError: It holds none.
    """
    path = folder / SETTINGS_FILE
    if not path.is_file():
        raise ValueError(f"Expected a training in {str(folder)!r}, but there is no {SETTINGS_FILE}.")
    noted = json.loads(path.read_text(encoding="utf-8"))
    source, config = noted["source"], {name: _tuples(value) for name, value in noted["config"].items()}
    config["colour"] = AutoregressiveNoise.from_json(noted["config"]["colour"])
    return replace(
        Source(source["kind"], Path(source["path"])),
        **{name: _tuples(source[name]) for name in ("location", "recordings", "seconds")},
    ), Config(**config)


def _tuples(value: Any) -> Any:
    """Return a list as a tuple, as JSON has none; other values as they are."""
    return tuple(value) if isinstance(value, list) else value
