"""Models of Stable-Baselines3 built from the bytes of a `.zip` that nobody has vouched for.

Its pickles are opened by `agents.sb3.safe_pickle` and its tensors by `agents.sb3.tensor_file`; what they hold goes to
Stable-Baselines3 in a new archive of our own. The file also says how large the networks are, and Stable-Baselines3
builds them before it compares them with the tensors, so a network of more numbers than the file holds is refused as it
is built.
"""

from __future__ import annotations

import base64
import io
import math
import re
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from gymnasium import spaces
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from agents.sb3.pickle_values import ForbiddenObject
from agents.sb3.safe_pickle import open_pickle
from agents.sb3.tensor_file import read_tensors
from agents.sb3.zip_header import make_training_stubs, read_header

MAX_OBSERVED = 2**22
"""Most numbers of an observation, and most actions to choose from."""
SPARE_NUMBERS, SPARE_TENSORS = 2**24, 10_000
"""Numbers and tensors that building may take beside a multiple of those in the file: buffers, initial values."""
_BUILT_PER_HELD = 8
"""Numbers and tensors that building may take for each in the file: the networks, initial values, optimisers."""
_FACTORY = re.compile(
    r"aten\.(new_)?(empty|zeros|ones|full|rand|randn|randint|arange|eye|randperm|linspace)(_strided)?\b"
)
"""Operations of torch that make a tensor of a size that they are told."""
_STATE_MEMBER = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*\.pth")
_TRAINING_MEMBERS = ("pytorch_variables.pth", "tensors.pth")
"""Members that only training needs."""


class _BoundedTensors(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Mode in which torch makes no more tensors and numbers than a limit."""

    def __init__(self, numbers: int, tensors: int) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._numbers, self._tensors = numbers, tensors

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if _FACTORY.match(str(func)):
            self._tensors -= 1
            self._numbers -= max((_count_numbers(one) for one in args), default=0)
            if self._numbers < 0 or self._tensors < 0:
                raise ForbiddenObject("it describes networks of more numbers than it holds")
        return func(*args, **(kwargs or {}))


def _count_numbers(argument: Any) -> int:
    """Return the numbers of a tensor of which this is the shape or the length."""
    if isinstance(argument, list | tuple) and all(isinstance(size, int) for size in argument):
        return math.prod(argument)
    return argument if isinstance(argument, int) else 0


def build_model(algorithm: Any, content: bytes, name: str) -> Any:
    """Return the model in a `.zip`, on the CPU.

    Args:
        algorithm: Its class in Stable-Baselines3.
        content: The file's.
        name: The file's, for messages.

    Raises:
        ForbiddenObject: It holds something that may run code, or builds more than it holds.
        Exception: It is damaged; anything may be raised.
    """
    given = make_training_stubs()
    given = {**open_objects(read_header(io.BytesIO(content), name), set(given)), **given}
    for key in ("observation_space", "action_space"):
        _check_space(given.get(key))
    clean, held = _rewrite(content)
    numbers, tensors = sum(one.numel() for one in held), len(held)
    with _BoundedTensors(SPARE_NUMBERS + _BUILT_PER_HELD * numbers, SPARE_TENSORS + _BUILT_PER_HELD * tensors):
        return algorithm.load(clean, device="cpu", custom_objects=given)


def open_objects(header: Mapping[str, Any], without: set[str]) -> dict[str, Any]:
    """Open the pickled entries of a model's settings safely.

    Raises:
        ForbiddenObject: One names a class or function that is not listed; the message names the entry.
    """
    opened = {}
    for key, value in header.items():
        if key in without or not isinstance(value, dict) or ":serialized:" not in value:
            continue
        try:
            opened[key] = open_pickle(base64.b64decode(str(value[":serialized:"])))
        except ForbiddenObject as error:
            raise ForbiddenObject(f"in its {key!r} {error}") from error
    return opened


def _rewrite(content: bytes) -> tuple[io.BytesIO, list[Tensor]]:
    """Return an archive of the same settings and of tensors that have been read safely, and these tensors."""
    clean, held = io.BytesIO(), list[Tensor]()
    with zipfile.ZipFile(io.BytesIO(content)) as given, zipfile.ZipFile(clean, "w") as archive:
        for member in dict.fromkeys(given.namelist()):
            if member in ("data", "_stable_baselines3_version"):
                archive.writestr(member, given.read(member))
            if _STATE_MEMBER.fullmatch(member) and member not in _TRAINING_MEMBERS:
                try:
                    state = read_tensors(given.read(member))
                except ForbiddenObject as error:
                    raise ForbiddenObject(f"in its {member!r} {error}") from error
                held += _find_tensors(state)
                with archive.open(member, "w") as file:
                    torch.save(state, file)
    clean.seek(0)
    return clean, held


def _find_tensors(value: Any) -> Iterator[Tensor]:
    """Yield the tensors in mappings and lists."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        for one in value.values():
            yield from _find_tensors(one)
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _find_tensors(one)


def _check_space(space: Any, depth: int = 0) -> None:
    """Refuse a space whose parts do not go together, or of which one element would fill the memory.

    Raises:
        ForbiddenObject: It is one.
    """
    if isinstance(space, spaces.Dict) and depth == 0:
        for part in space.spaces.values():
            _check_space(part, 1)
        return
    if isinstance(space, spaces.Box):
        good = space.low.shape == space.high.shape == space.shape and space.low.size <= MAX_OBSERVED
    elif isinstance(space, spaces.Discrete):
        good = 0 < int(space.n) <= MAX_OBSERVED
    elif isinstance(space, spaces.MultiDiscrete):
        good = 0 < int(space.nvec.sum()) <= MAX_OBSERVED
    else:
        good = isinstance(space, spaces.MultiBinary) and 0 < math.prod(space.shape) <= MAX_OBSERVED
    if not good:
        raise ForbiddenObject(f"its space is none that a policy could have ({type(space).__name__})")
