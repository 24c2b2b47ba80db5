"""Training of a driver: from recorded files to the last update, in a folder from which a stopped training goes on.

A folder holds `driver.safetensors` (see `agents.load_driver`), `training.json` (source and settings) and a checkpoint,
from which a stopped training is resumed to the same weights.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any

import torch

from agents import LearnedDriver, Provenance, save_driver
from agents.learned.networks import Policy
from rare_envs.devices import find_device
from rare_envs.files import replace_text
from training.data.formats import load_recordings
from training.data.scenes import TrafficScene, load_us101_scenes, scenes_of, split_by_clock
from training.imitation.adversarial import update_gail, update_mgail
from training.imitation.clone import ACTION_HIGH, ACTION_LOW, Pairs, clone_policy, collect_pairs, make_seeded
from training.imitation.config import Config
from training.imitation.evaluate import header_metrics
from training.imitation.learner import Critic, Learner, Log, Update, run_updates
from training.imitation.traffic import Recording, stack_scenes

CPU = torch.device("cpu")
UPDATE_RULES: dict[str, Update] = {"gail": update_gail, "mgail": update_mgail}
"""Update of each method."""
CHECKPOINT_INTERVAL = 50
"""Number of updates between checkpoints."""
DRIVER, SETTINGS_FILE, CHECKPOINT = "driver.safetensors", "training.json", "checkpoint.pt"
"""Names of the files in the folder of a training."""
SOURCE_KINDS = ("data", "ngsim", "highd", "tgsim", "i24")
"""Kinds of sources: those of recordings that have positions across the road."""
TEST_SHARE = 0.2
"""Share at the end of a user's recording that is kept for tests."""
_LICENCES = {
    "highd": "highD's: non-commercial, and neither the data nor what derives from it is passed on without leave",
    "tgsim": "public, as reported of TGSIM's records at data.transportation.gov",
    "i24": "the data use agreement of I-24 MOTION, which asks for a citation of Gloudemans et al., 2023",
}
_NGSIM_LICENCE = "CC BY-SA 3.0, as reported of the NGSIM record 8ect-6jqj"


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
    """"data" for a folder with the compact tables of US 101, or the format of the files, one of `SOURCE_KINDS`."""
    path: Path
    location: str | None = None
    """Location to read from a raw NGSIM file that has several."""
    recordings: tuple[str, ...] = ()
    """Numbers of highD recordings, such as "01"; empty for all that are in the folder."""
    seconds: float = 10.0
    """Duration of the scenes that a user's recording is cut into [s]."""

    def __post_init__(self) -> None:
        if self.kind not in SOURCE_KINDS:
            raise ValueError(f"Expected one of {', '.join(SOURCE_KINDS)}, got {self.kind!r}.")

    @property
    def description(self) -> str:
        """Description of the data, for users of a driver who do not have them."""
        if self.kind == "data":
            return "NGSIM US 101, 15 June 2005, 07:49:51 to 07:52:53 without 64 to 88 s and 158 to 193 s of its clock"
        names = {"ngsim": "NGSIM", "highd": "highD", "tgsim": "TGSIM", "i24": "I-24 MOTION"}
        parts = ", ".join(self.recordings) or ("all recordings" if self.kind == "highd" else self.path.stem)
        return f"{names[self.kind]}, {self.location or parts}, the first {1 - TEST_SHARE:.0%} of each recording"

    @property
    def licence(self) -> str:
        """Licence of the data."""
        return _LICENCES.get(self.kind, _NGSIM_LICENCE)

    @property
    def options(self) -> str:
        """The source as options of the command line; of the path only its name."""
        words = [f"--{self.kind}", self.path.name or str(self.path)]
        words += ["--location", self.location] if self.location else []
        for recording in self.recordings:
            words += ["--recording", recording]
        words += ["--seconds", f"{self.seconds:g}"] if self.seconds != Source.seconds else []
        return shlex.join(words)


def load_scenes(source: Source) -> tuple[tuple[TrafficScene, ...], tuple[TrafficScene, ...]]:
    """Return scenes to learn from and scenes to test on, which share no moment.

    Raises:
        ValueError: A file is missing or broken; see the loaders.

    Example:
        >>> load_scenes(Source("ngsim", Path("no_such_file.csv")))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: Cannot read no_such_file.csv: ...
    """
    if source.kind == "data":
        return split_by_clock(load_us101_scenes(source.path))
    tables = load_recordings(
        source.kind, source.path, location=source.location, recordings=source.recordings, gaps="cut"
    )
    return split_end([scene for table in tables for scene in scenes_of(table, source.seconds)])


def split_end(scenes: Sequence[TrafficScene]) -> tuple[tuple[TrafficScene, ...], tuple[TrafficScene, ...]]:
    """Split scenes into those to learn from and the last fifth of every recording; of a single scene none is kept."""
    learn: list[TrafficScene] = []
    test: list[TrafficScene] = []
    for _, group in groupby(scenes, key=lambda scene: scene.name.rsplit("-", 1)[0]):
        of_recording = list(group)
        kept = len(of_recording) - (max(round(TEST_SHARE * len(of_recording)), 1) if len(of_recording) > 1 else 0)
        learn += of_recording[:kept]
        test += of_recording[kept:]
    return tuple(learn), tuple(test)


@dataclass(frozen=True)
class Data:
    """Recorded traffic, prepared for trainings.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> data.test is None
        True
    """

    recording: Recording
    pairs: Pairs
    test: Recording | None
    """Scenes for tests; None if there are too few to keep some."""


def prepare_data(scenes: Sequence[TrafficScene], test: Sequence[TrafficScene] = ()) -> Data:
    """Return scenes as one recording, with the pairs of features and actions in them.

    Args:
        scenes: Scenes to learn from.
        test: Scenes kept for tests.

    Raises:
        ValueError: There is no scene, or nobody follows anybody in any of them.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> data.recording.x.shape, data.pairs.features.shape
        (torch.Size([3, 40, 9]), torch.Size([708, 51]))
    """
    if not scenes:
        raise ValueError("Expected scenes to learn from, got none.")
    recording = stack_scenes(scenes)
    pairs = collect_pairs(recording)
    if not len(pairs.scene):
        raise ValueError("Nobody follows anybody in these scenes, so there is nothing to learn.")
    return Data(recording, pairs, stack_scenes(test) if test else None)


def make_learner(data: Data, config: Config, among: torch.Tensor | None = None, device: torch.device = CPU) -> Learner:
    """Return a training before its first update: a cloned policy and a new critic.

    Args:
        data: Recorded traffic.
        config: Settings.
        among: Scenes that are driven, with repetition, shape (k,); None for all that have pairs.
        device: Where it is trained.

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
    critic = make_seeded(Critic, generator).to(device)
    among = torch.unique(pairs.scene) if among is None else among.to(device)
    return Learner(config, recording, among, pairs, policy, critic, generator)


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
        ValueError: Logs are to be written and TensorBoard is not installed.

    Example:
        >>> from training.data import scenes_of, synthetic_traffic
        >>> data = prepare_data(scenes_of(synthetic_traffic(), seconds=4.0))
        >>> config = Config(updates=1, epochs=1, pools=1, scenes=2, horizon=(3, 3), warm_up=0)
        >>> policy = train_learner(make_learner(data, config))
        >>> mean, log_std = policy(data.pairs.features)
        >>> mean.shape
        torch.Size([708, 2])
    """
    if out is not None and (out / CHECKPOINT).exists():
        learner.load(out / CHECKPOINT)
    with _progress_bar(learner, progress) as show, _tensorboard(out if log else None, learner.update) as write:
        for entry in run_updates(learner, UPDATE_RULES[learner.config.method]):
            show(learner, entry)
            write(learner, entry)
            if out is not None and (learner.update % every == 0 or learner.update == learner.config.updates):
                learner.save(out / CHECKPOINT)
    return learner.policy


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
        _summary_writer()
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
    source, config = ({name: _as_tuple(value) for name, value in noted[part].items()} for part in ("source", "config"))
    return Source(**{**source, "path": Path(source["path"])}), Config(**config)


def _as_tuple(value: Any) -> Any:
    """Return a list as a tuple, as JSON has none; other values as they are."""
    return tuple(value) if isinstance(value, list) else value


AfterUpdate = Callable[[Learner, Log], None]
"""Function that is called after every update."""


@contextlib.contextmanager
def _progress_bar(learner: Learner, show: bool) -> Iterator[AfterUpdate]:
    """Open a progress bar on standard error; yield the function to call after every update."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), disable=not show) as shown:
        task = shown.add_task("", total=learner.config.updates, completed=learner.update)

        def after(learner: Learner, entry: Log) -> None:
            text = ", ".join(f"{name} {entry[name]:.3f}" for name in ("collision", "edge", "critic"))
            shown.update(task, completed=learner.update, description=text)

        yield after


def _summary_writer() -> Any:
    """Return TensorBoard's class of writers.

    Raises:
        ValueError: TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError("Logs need TensorBoard: pip install 'rare-envs[logs]', or leave logs out.") from error
    return SummaryWriter


@contextlib.contextmanager
def _tensorboard(folder: Path | None, update: int) -> Iterator[AfterUpdate]:
    """Open TensorBoard logs in a folder, without what a stopped run left of later updates; None writes nothing."""
    if folder is None:
        yield lambda learner, entry: None
        return
    writer: Any = _summary_writer()(str(folder), purge_step=update + 1)

    def after(learner: Learner, entry: Log) -> None:
        for name, value in (*entry.items(), ("vehicle_steps", learner.simulated)):
            writer.add_scalar(name, value, learner.update)

    with contextlib.closing(writer):
        yield after
