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
from rare_envs.study.errors import BadInput
from rare_envs.study.question import TYPE_WORDS, Question, read_question

MAX_QUESTION_BYTES = 2**20
ENV_KEY = "env"
"""Key of the environment; the others are the options of `rare-envs estimate`, with - or _ between words."""
OPTION_KEYS = {ENV_KEY: "env_id", "confidence": "gate_confidence"}
"""Keys that are no names of fields of `Question`: they are called as the options are."""
EXECUTOR_KEYS: dict[str, tuple[type, ...]] = {
    "workers": (int,),
    "executor": (str,),
    "address": (str,),
    "time_limit": (int, float),
    "memory_limit": (int, float),
}
"""Options that say where simulations are made, which is no part of the question, with their types."""
COUNTS = ("workers", *(field.name for field in fields(Question) if field.type in ("int", "int | None")))
"""Keys of whole numbers, which may be written as 1e6."""
NOT_IN_FILES = ("trust",)
"""Whoever asks decides whether code runs, not a file."""


INTEGER, FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"


def _is_whole(value: Any) -> bool:
    return isinstance(value, float) and value.is_integer()


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
    """Return the fields of `Question` that a file gives, and the options of `EXECUTOR_KEYS`.

    Args:
        path: Of a YAML file, which may be JSON.

    Raises:
        BadInput: It cannot be read, or has unknown keys or values of a wrong type.
    """
    given = _load_mapping(path)
    named = {_find_field(key): value for key, value in given.items()}
    known = [*(field.name for field in fields(Question) if field.name not in NOT_IN_FILES), *EXECUTOR_KEYS]
    for key in given:
        name = _find_field(key)
        if name in NOT_IN_FILES:
            raise BadInput(f"{str(path)!r} cannot say {key}: give --{key} on the command line.")
        if name not in known:
            options = {name: option for option, name in OPTION_KEYS.items()}
            names = [options.get(each, each) for each in known]
            hint = did_you_mean(key.replace("-", "_"), names)
            raise BadInput(f"{str(path)!r} has an unknown key {key!r}{hint}. It may have: {', '.join(names)}.")
    if len(named) < len(given):
        raise BadInput(f"{str(path)!r} gives the same option twice.")
    named = {name: int(value) if name in COUNTS and _is_whole(value) else value for name, value in named.items()}
    try:
        read_question({"env_id": "", **named})
    except BadInput as error:
        text = str(error).replace(" of the recorded question", "").replace("gate_confidence", "confidence")
        raise BadInput(f"{str(path)!r}: {text}") from error
    for name, types in EXECUTOR_KEYS.items():
        value = named.get(name)
        if value is not None and (not isinstance(value, types) or isinstance(value, bool)):
            expected = " or ".join(TYPE_WORDS[kind.__name__] for kind in types)
            raise BadInput(f"{str(path)!r}: Expected {name} to be {expected}, got {reprlib.repr(value)}.")
    return named


def _find_field(key: str) -> str:
    """Return the name of the field or option that a key stands for."""
    name = key.replace("-", "_")
    return OPTION_KEYS.get(name, name)


def join_question(given: Mapping[str, Any], env: str | None, options: Mapping[str, Any], typed: set[str]) -> Question:
    """Return the question of a file and a command line.

    Args:
        given: Fields that the file gives.
        env: Environment on the command line, if there is one.
        options: All options, with their defaults.
        typed: Names of those that were typed; they come before the file.

    Raises:
        BadInput: Neither names an environment.
    """
    named = {**options, **given, **{name: value for name, value in options.items() if name in typed}}
    if env is not None:
        named["env_id"] = env
    if "env_id" not in named:
        raise BadInput(f"Expected an environment: rare-envs estimate ENV, or {ENV_KEY}: ENV in the file of --config.")
    return Question(**named)


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
