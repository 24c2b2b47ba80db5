"""Training of a driver: from recorded files to the last update, in a folder from which a stopped training goes on.

A folder holds `driver.safetensors` (see `agents.load_driver`), `training.json` (source and settings) and a checkpoint,
from which a stopped training is resumed to the same weights.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import torch

from agents import LearnedDriver, Provenance, save_driver
from agents.learned.networks import Policy
from rare_envs.devices import find_device
from rare_envs.files import parse_json_object, read_text_file, replace_text
from rare_envs.startup import advise_install
from samplers.estimation import defer_signals
from training.checkpoints import TrainingInterrupted
from training.data.formats import load_recordings
from training.data.scenes import TrafficScene, load_us101_scenes, scenes_of, split_by_clock
from training.imitation.config import Config
from training.imitation.evaluate import header_metrics
from training.imitation.learner import Learner, clone_policy, make_critic, make_seeded, run_updates
from training.imitation.traffic import ACTION_HIGH, ACTION_LOW, Pairs, Recording, collect_pairs, stack_scenes

CPU = torch.device("cpu")
CHECKPOINT_INTERVAL = 50
"""Number of updates between checkpoints."""
DRIVER, SETTINGS_FILE, CHECKPOINT = "driver.safetensors", "training.json", "checkpoint.pt"
"""Names of the files in the folder of a training."""
TEST_SHARE = 0.2
"""Share at the end of a user's recording that is kept for tests."""
SOURCES = {
    "data": ("NGSIM US 101", "CC BY-SA 3.0, as reported of the NGSIM record 8ect-6jqj"),
    "ngsim": ("NGSIM", "CC BY-SA 3.0, as reported of the NGSIM record 8ect-6jqj"),
    "highd": (
        "highD",
        "highD's: non-commercial, and neither the data nor what derives from it is passed on without leave",
    ),
    "tgsim": ("TGSIM", "public, as reported of TGSIM's records at data.transportation.gov"),
    "i24": (
        "I-24 MOTION",
        "the data use agreement of I-24 MOTION, which asks for a citation of Gloudemans et al., 2023",
    ),
}
"""Name and licence of each kind of source: those of recordings that have positions across the road."""


@dataclass(frozen=True)
class Source:
    """Recorded traffic in files.

    Raises:
        ValueError: The kind is unknown.

    Example:
        >>> source = Source("highd", Path("highD/data"), recordings=("01", "02"))
        >>> source.options
        '--highd data --recording 01 --recording 02'
    """

    kind: str
    """"data" for a folder with the compact tables of US 101, or the format of the files, one of `SOURCES`."""
    path: Path
    location: str | None = None
    """Location to read from a raw NGSIM file that has several."""
    recordings: tuple[str, ...] = ()
    """Numbers of highD recordings, such as "01"; empty for all that are in the folder."""
    seconds: float = 10.0
    """Duration of the scenes that a user's recording is cut into [s]."""

    def __post_init__(self) -> None:
        if self.kind not in SOURCES:
            raise ValueError(f"Expected one of {', '.join(SOURCES)}, got {self.kind!r}.")

    @property
    def description(self) -> str:
        """Description of the data, for users of a driver who do not have them."""
        if self.kind == "data":
            return "NGSIM US 101, 15 June 2005, 07:49:51 to 07:52:53 without 64 to 88 s and 158 to 193 s of its clock"
        parts = ", ".join(self.recordings) or ("all recordings" if self.kind == "highd" else self.path.stem)
        share = f"the first {1 - TEST_SHARE:.0%} of each recording"
        return f"{SOURCES[self.kind][0]}, {self.location or parts}, {share}"

    @property
    def licence(self) -> str:
        """Licence of the data."""
        return SOURCES[self.kind][1]

    @property
    def options(self) -> str:
        """The source as options of the command line; of the path only its name."""
        words = [f"--{self.kind}", self.path.name or str(self.path)]
        words += ["--location", self.location] if self.location else []
        for recording in self.recordings:
            words += ["--recording", recording]
        words += ["--seconds", f"{self.seconds:g}"] if self.seconds != Source.seconds else []
        return shlex.join(words)


Scenes = tuple[TrafficScene, ...]


def load_scenes(source: Source) -> tuple[Scenes, Scenes]:
    """Return scenes to learn from and scenes to test on, which share no moment."""
    if source.kind == "data":
        return split_by_clock(load_us101_scenes(source.path))
    places: dict[str, Any] = {"location": source.location, "recordings": source.recordings}
    tables = load_recordings(source.kind, source.path, **places, gaps="cut")
    return split_end([scene for table in tables for scene in scenes_of(table, source.seconds)])


def split_end(scenes: Sequence[TrafficScene]) -> tuple[Scenes, Scenes]:
    """Split scenes into those to learn from and the last fifth of every recording; of a single scene none is kept."""
    learn: list[TrafficScene] = []
    test: list[TrafficScene] = []
    for _, group in groupby(scenes, key=lambda scene: scene.name.rsplit("-", 1)[0]):
        of_recording = list(group)
        kept = len(of_recording) - (max(round(TEST_SHARE * len(of_recording)), 1) if len(of_recording) > 1 else 0)
        learn += of_recording[:kept]
        test += of_recording[kept:]
    return tuple(learn), tuple(test)


class Data(NamedTuple):
    """Recorded traffic, prepared for trainings."""

    recording: Recording
    pairs: Pairs
    test: Recording | None
    """Scenes for tests; None if there are too few to keep some."""


def prepare_data(scenes: Sequence[TrafficScene], test: Sequence[TrafficScene] = ()) -> Data:
    """Return scenes to learn from as one recording, with their pairs of features and actions, and scenes for tests.

    Raises:
        ValueError: There is no scene, or nobody follows anybody in any of them.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> data.recording.x.shape, data.pairs.features.shape
        (torch.Size([3, 40, 9]), torch.Size([708, 51]))
    """
    recording = stack_scenes(scenes)
    pairs = collect_pairs(recording)
    if not len(pairs.scene):
        raise ValueError("Nobody follows anybody in these scenes, so there is nothing to learn.")
    return Data(recording, pairs, stack_scenes(test) if test else None)


def make_learner(data: Data, config: Config, device: torch.device = CPU) -> Learner:
    """Return a training before its first update: a cloned policy and a new critic; scenes that have pairs are driven.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> learner = make_learner(data, Config(epochs=1))
        >>> learner.update
        0
    """
    generator = torch.Generator().manual_seed(config.seed)
    recording = Recording(*(field.to(device) for field in data.recording))
    pairs = Pairs(*(field.to(device) for field in data.pairs))
    policy = clone_policy(pairs, config, generator)
    critic = make_seeded(make_critic, generator).to(device)
    return Learner(config, recording, torch.unique(pairs.scene), pairs, policy, critic, generator)


def train_learner(
    learner: Learner,
    out: Path | None = None,
    log: bool = False,
    progress: bool = False,
    every: int = CHECKPOINT_INTERVAL,
) -> Policy:
    """Make the remaining updates of a training and return its policy: that after the last update, never the best.

    Args:
        learner: A training, as `make_learner` returns it.
        out: Folder of the checkpoint; a training found there is resumed. None keeps no checkpoint.
        log: Write TensorBoard logs to the folder.
        progress: Show a bar on standard error.
        every: Number of updates between checkpoints.

    Raises:
        TrainingInterrupted: After a signal, which waits for the end of an update; `out` has what is done.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> config = Config(updates=1, epochs=1, pools=1, scenes=2, horizon=(3, 3), warm_up=0)
        >>> policy = train_learner(make_learner(data, config))
        >>> mean, log_std = policy(data.pairs.features)
        >>> mean.shape
        torch.Size([708, 2])
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    if out is not None and (out / CHECKPOINT).exists():
        learner.load(out / CHECKPOINT)
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    bar = Progress(*columns, console=Console(stderr=True), disable=not progress)
    stopped = KeyboardInterrupt("stopped")
    try:
        with bar, _tensorboard(out if log else None, learner.update) as writer, defer_signals() as received:
            task = bar.add_task("", total=learner.config.updates, completed=learner.update)
            for entry in run_updates(learner):
                text = ", ".join(f"{name} {entry[name]:.3f}" for name in ("collision", "edge", "critic"))
                bar.update(task, completed=learner.update, description=text)
                for name, value in (*entry.items(), ("vehicle_steps", learner.simulated)) if writer else ():
                    writer.add_scalar(name, value, learner.update)
                n, whole = learner.update, learner.config.updates
                if out is not None and (received or n % every == 0 or n == whole):
                    learner.save(out / CHECKPOINT)
                    kept = f"{n:,} of {whole:,} updates are kept in {str(out)!r}"
                    stopped = TrainingInterrupted(f"Stopped: {kept}: go on by the same command.")
                if received:
                    break
    except KeyboardInterrupt:
        raise stopped from None
    return learner.policy


def _tensorboard(folder: Path | None, update: int) -> contextlib.AbstractContextManager[Any]:
    """Open TensorBoard logs in a folder, without what a stopped run left of later updates; None gives None."""
    if folder is None:
        return contextlib.nullcontext()
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError(f"Logs need TensorBoard: {advise_install('logs')}, or leave logs out.") from error
    return contextlib.closing(SummaryWriter(str(folder), purge_step=update + 1))


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
        device: "cpu", or a GPU, such as "cuda", whose weights differ by rounding that grows with the updates.

    Returns:
        The file of the driver.

    Raises:
        ValueError: The data cannot be read, the folder holds another training, or TensorBoard is not installed.

    Example:
        >>> train_driver(Source("data", Path("no_such_folder")), Config(), Path("out"))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: There is no ngsim_us101_scenes.parquet in the folder 'no_such_folder'. ...
    """
    place = find_device(device)
    with claim_folder(out, source, config):
        data = prepare_data(*load_scenes(source))
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
        >>> config = Config(epochs=1)
        >>> driver = driver_of(make_learner(data, config).policy, config)
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
            parts = value if isinstance(value, tuple) else (value,)
            words += ["--" + option.name.replace("_", "-"), *(str(part) for part in parts)]
    words += [] if device == "cpu" else ["--device", device]
    return f"python -m training.imitation {source.options} {shlex.join(words)}"


@contextlib.contextmanager
def claim_folder(out: Path, source: Source, config: Config) -> Iterator[None]:
    """Check that a folder can take a training, and write its settings into it if the block, which reads, succeeds.

    A ValueError says that it is a file, cannot be made, or holds a training with other settings.
    """
    settings = {"source": {**asdict(source), "path": str(source.path)}, "config": asdict(config)}
    text = json.dumps(settings, indent=1)
    if out.exists() and not out.is_dir():
        raise ValueError(f"Expected a folder for the training, got the file {str(out)!r}.")
    begun, noted = any((out / name).exists() for name in (CHECKPOINT, DRIVER)), out / SETTINGS_FILE
    noted_text = read_text_file(noted) if begun and noted.exists() else "{}"
    if begun and parse_json_object(noted_text, repr(str(noted))) != json.loads(text):
        raise ValueError(f"{str(out)!r} holds a training with other settings; choose another folder or remove it.")
    yield
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"Cannot make the folder {str(out)!r}: {error}.") from None
    replace_text(noted, text + "\n")


def read_training_settings(folder: Path) -> tuple[Source, Config]:
    """Return source and settings of the training in a folder; a ValueError if it holds none."""
    path = folder / SETTINGS_FILE
    if not path.is_file():
        raise ValueError(f"Expected a training in {str(folder)!r}, but there is no {SETTINGS_FILE}.")
    noted = parse_json_object(read_text_file(path), repr(str(path)))
    for part in noted.values():  # JSON has lists
        part |= {name: tuple(value) for name, value in part.items() if isinstance(value, list)}
    return Source(**{**noted["source"], "path": Path(noted["source"]["path"])}), Config(**noted["config"])
