"""Sources of recorded scenes: the tables of US 101, or files of a user's own."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from training.data.formats.recordings import load_recordings
from training.data.scenes import TrafficScene, load_us101_scenes, split_by_clock
from training.data.windows import scenes_of

SOURCE_KINDS = ("data", "ngsim", "highd", "tgsim", "i24")
"""Kinds of sources: those of recordings that have positions across the road."""
TEST_SHARE = 0.2
"""Share at the end of a user's recording that is kept for tests."""
_NGSIM = "CC BY-SA 3.0, as reported of the NGSIM record 8ect-6jqj"
_TGSIM = "public, as reported of TGSIM's records at data.transportation.gov"
_I24 = "the data use agreement of I-24 MOTION, which asks for a citation of Gloudemans et al., 2023"
_HIGHD = "highD's: non-commercial, and neither the data nor what derives from it is passed on without leave"
_FILES = {"tgsim": "TGSIM", "i24": "I-24 MOTION"}


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
        if self.kind == "ngsim":
            return f"NGSIM, {self.location or self.path.stem}, the first {1 - TEST_SHARE:.0%}"
        if self.kind in _FILES:
            return f"{_FILES[self.kind]}, {self.path.stem}, the first {1 - TEST_SHARE:.0%} of each recording"
        return f"highD, {', '.join(self.recordings) or 'all recordings'}, the first {1 - TEST_SHARE:.0%} of each"

    @property
    def licence(self) -> str:
        """Licence of the data."""
        return {"highd": _HIGHD, "tgsim": _TGSIM, "i24": _I24}.get(self.kind, _NGSIM)

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


def split_end(
    scenes: tuple[TrafficScene, ...] | list[TrafficScene],
) -> tuple[tuple[TrafficScene, ...], tuple[TrafficScene, ...]]:
    """Split scenes into those to learn from and the last fifth of every recording; of a single scene none is kept."""
    learn: list[TrafficScene] = []
    test: list[TrafficScene] = []
    for _, group in groupby(scenes, key=lambda scene: scene.name.rsplit("-", 1)[0]):
        of_recording = list(group)
        kept = len(of_recording) - (max(round(TEST_SHARE * len(of_recording)), 1) if len(of_recording) > 1 else 0)
        learn += of_recording[:kept]
        test += of_recording[kept:]
    return tuple(learn), tuple(test)
