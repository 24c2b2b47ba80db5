"""Recordings by the kind of their format."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from training.data.formats.coifman_li import load_coifman_li
from training.data.formats.highd import highd_recordings, load_highd
from training.data.formats.i24_motion import load_i24_motion
from training.data.formats.ngsim import load_ngsim
from training.data.formats.text_columns import Gaps
from training.data.formats.tgsim import find_tgsim_files, load_tgsim
from training.data.trajectories import Trajectories

RECORDING_KINDS = ("ngsim", "highd", "tgsim", "i24", "coifman")
"""Kinds of files that are read, as options of the command line call them."""


def load_recordings(
    kind: str,
    path: Path | str,
    *,
    location: str | None = None,
    recordings: tuple[str, ...] = (),
    between: tuple[float, float] | None = None,
    gaps: Gaps = "error",
) -> Iterator[Trajectories]:
    """Yield the tables of files of one kind, each read when it is asked for.

    Args:
        kind: One of `RECORDING_KINDS`.
        path: File, or folder of highD or TGSIM.
        location: Which of the locations of an NGSIM file to read, where it has several.
        recordings: Which recordings of highD to read, such as "01"; all if empty.
        between: First and last moment of I-24 MOTION to read, Unix time [s]; everything if None.
        gaps: What is done where a vehicle is missing for some frames: "error" raises, "cut" cuts its track.

    Raises:
        ValueError: The kind is unknown, or a file is missing or broken.

    Example:
        >>> next(load_recordings("tgsim", "no_such_folder"))
        Traceback (most recent call last):
        ValueError: no_such_folder has no CSV file with a column xloc_kf; is it a folder with files of TGSIM?
    """
    if kind == "highd":
        yield from (load_highd(path, name, gaps=gaps) for name in recordings or highd_recordings(path))
    elif kind == "tgsim":
        yield from (load_tgsim(file, gaps=gaps) for file in find_tgsim_files(path))
    elif kind == "ngsim":
        yield load_ngsim(path, location=location, gaps=gaps)
    elif kind == "i24":
        yield load_i24_motion(path, between=between, gaps=gaps)
    elif kind == "coifman":
        yield load_coifman_li(path, gaps=gaps)
    else:
        raise ValueError(f"Expected one of {', '.join(RECORDING_KINDS)}, got {kind!r}.")
