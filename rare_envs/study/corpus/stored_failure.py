"""Stored failure: a scenario in which an ego failed, with all that another ego needs to be put into it."""

from __future__ import annotations

import hashlib
import json
import math
import reprlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.files import check_ordinary
from rare_envs.json_text import parse_json_object
from rare_envs.scenarios.registry import find_scenario
from rare_envs.study.question import Question
from rare_envs.version import __version__

STORED_FORMAT = 1
"""Number of the format."""
MAX_STORED = 2**26
"""Bytes of a file that are read at most; 400,000 values take 10 MB."""
MAX_WORD = 300
"""Letters of a word that is shown."""
WORLD_FIELDS = ("measure", "gamma", "noise", "drivers", "horizon", "collisions", "weather")
"""Fields of a `Question` that decide what happens in a scenario and what counts as a failure, the ego apart."""


@dataclass(frozen=True)
class StoredFailure:
    """A scenario in which an ego failed.

    Attributes:
        env_id: The environment.
        world: Values of `WORLD_FIELDS`.
        x: Scenario parameters by name, each of shape (size,).
        f: The measure that was recorded.
        log_p0: Log density under the base distribution.
        ego: The ego that failed, as its run named it.
        crash: Kind of its crash, in words.
        base: Base distribution of the run; the scenario's default when None. It says how likely x is, and does not
            change what happens in it.
        versions: Versions of this program and of the libraries that simulate.

    Example:
        >>> world = {**{name: getattr(Question(env_id=""), name) for name in WORLD_FIELDS}, "horizon": 4.0}
        >>> x = {"ego_speed": [20.0], "lead_speed": [5.0], "gap": [10.0]}
        >>> stored = StoredFailure("rare_envs/CarFollowing-v0", world, x, f=-1.0, log_p0=-9.0, ego="idm")
        >>> stored.key, parse_stored(stored.to_json(), "the file") == stored
        ('d1b67d1f89efd1b8', True)
    """

    env_id: str
    world: Mapping[str, Any]
    x: Mapping[str, list[float]]
    f: float
    log_p0: float
    ego: str = ""
    crash: str = ""
    base: str | None = None
    versions: Mapping[str, str] | None = None

    @property
    def digest(self) -> str:
        """SHA-256 of what decides the scenario: environment, world and x."""
        content = [self.env_id, dict(self.world), dict(self.x)]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def key(self) -> str:
        """First letters of `digest`: the name of its file."""
        return self.digest[:16]

    @property
    def gamma(self) -> float:
        """Threshold: f of this or less is a failure."""
        return float(self.world["gamma"])

    def question_values(self) -> dict[str, Any]:
        """Return the scenario as values of a `Question`, with the rule-based ego in it."""
        return {"env_id": self.env_id, "ego": "idm", **self.world}

    def to_json(self) -> str:
        """Return the text of its file."""
        content = {"format": STORED_FORMAT, "sha256": self.digest, **asdict(self)}
        content["f"], content["log_p0"] = (value if math.isfinite(value) else None for value in (self.f, self.log_p0))
        return json.dumps(content, allow_nan=False, indent=1) + "\n"


def describe_versions() -> dict[str, str]:
    """Return the versions that the outcome of a simulation may depend on."""
    import torch

    return {"rare_envs": __version__, "torch": torch.__version__, "numpy": np.__version__}


def make_stored(
    question: Question, x: Mapping[str, NDArray[np.float64]], f: float, log_p0: float, crash: str
) -> StoredFailure:
    """Return a failure of a run as it is stored.

    Args:
        question: Of the run.
        x: Parameters by name, each a number or (size,).
        f: The measure.
        log_p0: Log density.
        crash: Kind of crash.
    """
    values = {name: np.atleast_1d(part).astype(np.float64).tolist() for name, part in x.items()}
    world = {name: getattr(question, name) for name in WORLD_FIELDS}
    base, versions = _name_base(question), describe_versions()
    return StoredFailure(question.env_id, world, values, f, log_p0, question.ego, crash, base, versions)


def _name_base(question: Question) -> str | None:
    """Return the name of the base distribution, the scenario's default where the question names none."""
    try:
        return question.base or find_scenario(question.env_id).default_base
    except ValueError:  # a scenario of the user's that is not there any longer
        return None


def parse_stored(text: str, source: str) -> StoredFailure:
    """Return the failure that a file has.

    Args:
        text: Of the file, which anybody may have written.
        source: Its name, for messages.

    Raises:
        ValueError: It is no stored failure, or was changed after it was written.
    """
    content = parse_json_object(text, source)
    if content.get("format") != STORED_FORMAT:
        raise ValueError(f"{source}: expected format {STORED_FORMAT}, got {reprlib.repr(content.get('format'))}.")
    try:
        stored = StoredFailure(**{each.name: content[each.name] for each in fields(StoredFailure)})
    except KeyError as error:
        raise ValueError(f"{source} has no {error}.") from None
    _check_words(stored, source)
    _check_numbers(stored, source)
    if stored.digest != content.get("sha256"):
        raise ValueError(f"{source}: the scenario is not the one that was stored (its sha256 differs).")
    f, log_p0 = (math.nan if value is None else float(value) for value in (stored.f, stored.log_p0))
    return StoredFailure(
        **{**{each.name: content[each.name] for each in fields(StoredFailure)}, "f": f, "log_p0": log_p0}
    )


def _check_words(stored: StoredFailure, source: str) -> None:
    words = (stored.env_id, stored.ego, stored.crash)
    if not all(isinstance(word, str) and len(word) <= MAX_WORD for word in words):
        raise ValueError(f"{source}: expected env_id, ego and crash of up to {MAX_WORD} letters.")
    if stored.base is not None and not isinstance(stored.base, str):
        raise ValueError(f"{source}: expected base to be a name or null.")
    if not isinstance(stored.world, dict) or set(stored.world) != set(WORLD_FIELDS):
        raise ValueError(f"{source}: expected a world with {', '.join(WORLD_FIELDS)}.")


def _check_numbers(stored: StoredFailure, source: str) -> None:
    x = stored.x
    rows = x.values() if isinstance(x, dict) else ()
    if not rows or not all(isinstance(row, list) and all(_is_number(value) for value in row) for row in rows):
        raise ValueError(f"{source}: expected x with lists of finite numbers by name.")
    gamma = stored.world["gamma"]
    if not _is_number(gamma) or not all(value is None or _is_number(value) for value in (stored.f, stored.log_p0)):
        raise ValueError(f"{source}: expected gamma, f and log_p0 to be numbers.")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def read_stored(path: Path) -> StoredFailure:
    """Read a file of a corpus.

    Raises:
        ValueError: It is no stored failure.
        OSError: It cannot be read.
    """
    check_ordinary(path, MAX_STORED)
    content = path.read_bytes()
    return parse_stored(content.decode("utf-8", "replace"), repr(str(path)))
