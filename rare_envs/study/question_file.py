"""Question of `rare-envs estimate` as a YAML file: one key for each option, by its name."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar

import yaml

from rare_envs.plugins import did_you_mean
from rare_envs.study.arguments import ExecutorOptions, Question, check_types, option_name
from rare_envs.study.errors import BadInput

MAX_QUESTION_BYTES = 2**20
NOT_IN_FILES = ("trust",)
"""Whoever asks decides whether code runs, not a file."""
KEYS = {option_name(each): each for kind in (Question, ExecutorOptions) for each in fields(kind)}
"""Keys, with - or _ between words, and the fields that they stand for."""
INTEGER, FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"


class QuestionLoader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """YAML with the numbers of YAML 1.2: 1e-4 is one, where 1.1 has a text, and 12:30 is none, where 1.1 has 750.

    Words for yes and no are those of 1.1: on, off, yes and no are among them.
    """

    yaml_implicit_resolvers: ClassVar = {
        first: [(tag, pattern) for tag, pattern in found if tag not in (INTEGER, FLOAT)]
        for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_decimal(self, node: yaml.ScalarNode) -> int:
        """Return a whole number, which begins with zeros or not."""
        return int(self.construct_scalar(node))


QuestionLoader.add_constructor(INTEGER, QuestionLoader.construct_decimal)
QuestionLoader.add_implicit_resolver(INTEGER, re.compile(r"[-+]?[0-9]+$"), list("-+0123456789"))
QuestionLoader.add_implicit_resolver(
    FLOAT,
    re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"),
    list("-+0123456789."),
)


def read_question_file(path: Path) -> dict[str, Any]:
    """Return the fields of `Question` and `ExecutorOptions` that a YAML file, which may be JSON, gives."""
    given = _load_mapping(path)
    named = {key.replace("-", "_"): value for key, value in given.items()}
    for key, name in zip(given, (key.replace("-", "_") for key in given), strict=True):
        if name in NOT_IN_FILES:
            raise BadInput(f"{str(path)!r} cannot say {key}: give --{key} on the command line.")
        if name not in KEYS:
            known = [each for each in KEYS if each not in NOT_IN_FILES]
            hint = did_you_mean(name, known)
            raise BadInput(f"{str(path)!r} has an unknown key {key!r}{hint}. It may have: {', '.join(known)}.")
    if len(named) < len(given):
        raise BadInput(f"{str(path)!r} gives the same option twice.")
    named = {name: _as_whole(name, value) for name, value in named.items()}
    try:
        check_types({name: KEYS[name] for name in named}, named)
    except BadInput as error:
        raise BadInput(f"{str(path)!r}: {error}") from error
    return {KEYS[name].name: value for name, value in named.items()}


def _as_whole(name: str, value: Any) -> Any:
    """Return the value of a key; a whole number where it takes one, which may be written as 1e6."""
    whole = "int" in str(KEYS[name].type).split(" | ") and isinstance(value, float) and value.is_integer()
    return int(value) if whole else value


def join_question(given: Mapping[str, Any], env: str | None, options: Mapping[str, Any], typed: set[str]) -> Question:
    """Return the question of a file and a command line."""
    named = join_options(given, options, typed)
    if env is not None:
        named["env_id"] = env
    if "env_id" not in named:
        raise BadInput("Expected an environment: rare-envs estimate ENV, or env: ENV in the file of --config.")
    return Question(**named)


def join_options(given: Mapping[str, Any], options: Mapping[str, Any], typed: set[str]) -> dict[str, Any]:
    """Return options by name: what was typed, else what a file gives, else the default."""
    return {**options, **given, **{name: value for name, value in options.items() if name in typed}}


def _load_mapping(path: Path) -> dict[str, Any]:
    """Return what a YAML file holds, with words as keys."""
    try:
        if path.stat().st_size > MAX_QUESTION_BYTES:
            raise BadInput(f"{str(path)!r} has more than {MAX_QUESTION_BYTES:,} bytes.")
        text = path.read_text(encoding="utf-8")
        given = yaml.load(text, Loader=QuestionLoader)
        _refuse_repeated_keys(path, text)
    except OSError as error:
        raise BadInput(f"Cannot read {str(path)!r}: {error.strerror}.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise BadInput(f"{str(path)!r} is no YAML: {error}") from error
    if given is None:
        raise BadInput(f"{str(path)!r} has no keys: expected lines like gamma: 0.0.")
    if not isinstance(given, dict) or not all(isinstance(key, str) for key in given):
        raise BadInput(f"Expected {str(path)!r} to have lines like gamma: 0.0, got {reprlib.repr(given)}.")
    return given


def _refuse_repeated_keys(path: Path, text: str) -> None:
    """Refuse a key that stands twice, of which PyYAML takes the last one without a word."""
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    keys = [key.value for key, _ in node.value] if isinstance(node, yaml.MappingNode) else []
    for key in keys:
        if keys.count(key) > 1:
            raise BadInput(f"{str(path)!r} has the key {key!r} more than once.")
