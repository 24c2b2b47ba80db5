"""Damaged and hostile files of saved policies, and a program that loads each and prints what became of it.

    python -m tests.agents.sb3.hostile_files FOLDER

loads every `.zip` in a folder, and prints a line of JSON for each: the class and the message of the error, and by how
much the largest memory of the process has grown [MB]. A process of its own, because a regression may crash it.
"""

from __future__ import annotations

import base64
import io
import json
import pickle
import resource
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy._core.multiarray import _reconstruct
from numpy._core.numeric import _frombuffer


class Call:
    """What a pickle can do: call anything when it is opened, and fill what that returns."""

    def __init__(self, function: Any, *arguments: Any, state: Any = None) -> None:
        self.parts = (function, arguments, state) if state is not None else (function, arguments)

    def __reduce__(self) -> Any:
        return self.parts


def _doubled(depth: int) -> bytes:
    return b"".join([b"2\x86" for _ in range(depth)])  # DUP, TUPLE2


def pickles(mark: Path) -> dict[str, bytes]:
    """Pickles by what they try."""
    addresses = b"\x41" * 8
    numbers = np.dtype("<f8")
    twister = np.random.MT19937(0).state
    twister["state"]["pos"] = 10**6
    objects = {
        "objects over bytes": Call(np.ndarray, (1,), np.dtype("O"), addresses),
        "objects in a record": Call(np.ndarray, (1,), np.dtype([("a", "O")]), bytearray(addresses)),
        "buffer of objects": Call(_frombuffer, addresses, np.dtype("O"), (1,), "C"),
        "array beyond its bytes": Call(_frombuffer, addresses, numbers, (10**6,), "C"),
        "array of strides": Call(np.ndarray, (10**6,), numbers, bytearray(8), 0, (8,)),
        "filled with objects": Call(
            _reconstruct, np.ndarray, (0,), b"b", state=(1, (1,), np.dtype("O"), False, [print])
        ),
        "filled too little": Call(_reconstruct, np.ndarray, (0,), b"b", state=(1, (10**9,), numbers, False, b"")),
        "huge array": Call(_reconstruct, np.ndarray, (10**11,), b"b"),
        "strange dtype": Call(np.dtype, "f8", state=(3, "<", None, ("a",), {"a": (numbers, 10**9)}, 8, 1, 0)),
        "many bytes": Call(bytearray, 10**11),
        "code": Call(Path.mkdir, mark),
        "attribute": Call(getattr, mark, "mkdir"),
        "large layer": Call(torch.nn.Linear, 10**6, 10**6),
        "large space": Call(spaces.Box, 0.0, 1.0, (10**6, 10**6)),
        "class filled": Call(_give, torch.nn.ReLU),
        "generator beyond its key": Call(np.random.MT19937, state=(twister, None)),
        "range": Call(range, 10**12),
    }
    found = {name: pickle.dumps(value) for name, value in objects.items()}
    steps = {
        "slow key": b"\x80\x04})" + _doubled(45) + b"K\x01s.",
        "slow set": b"\x80\x04\x8f()" + _doubled(45) + b"\x90.",
        "outside": b"\x80\x04\x8c\x01aQ.",
        "old instance": b"(S'true'\nios\nsystem\n.",
        "by number": b"\x80\x04\x82\x01.",
        "buffer outside": b"\x80\x05\x97.",
        "module's class": b"\x80\x04\x8c\x22stable_baselines3.common.save_util\x8c\x0dBaseAlgorithm\x93.",
        "class told": b"\x80\x04\x8c\x08torch.nn\x8c\x04ReLU\x93}\x8c\x07forward\x8c\x01xsb.",
        "nothing": b"",
        "cut": pickle.dumps([1] * 100)[:-3],
        "huge number": b"I" + b"9" * 5000 + b"\n.",
        "append to text": b"\x80\x04\x8c\x01aK\x01a.",
        "claims length": b"\x80\x04\x8e" + (2**40).to_bytes(8, "little") + b"abc.",
        "far memo": b"\x80\x04K\x01r\xff\xff\xff\x7f.",
    }
    return {**found, **steps}


def _give(value: Any) -> Any:
    return value


class Storage(NamedTuple):
    """A storage of a `.pth`: a record in the archive, said to hold so many numbers."""

    count: int


class Tensors(pickle.Pickler):
    """Pickles as torch writes them."""

    def persistent_id(self, value: Any) -> Any:
        return ("storage", torch.FloatStorage, "0", "cpu", value.count) if isinstance(value, Storage) else None


def tensor_members(mark: Path) -> dict[str, bytes]:
    """Contents of `policy.pth` by what they try."""

    def archive(value: Any, content: bytes = bytes(8), kind: int = zipfile.ZIP_STORED) -> bytes:
        pickled, file = io.BytesIO(), io.BytesIO()
        Tensors(pickled, protocol=2).dump(value)
        with zipfile.ZipFile(file, "w", kind, compresslevel=1) as written:
            members = {"data.pkl": pickled.getvalue(), "version": b"3\n", "byteorder": b"little", "data/0": content}
            for name, each in members.items():
                written.writestr(f"archive/{name}", each)
        return file.getvalue()

    def tensor(count: int, shape: tuple[int, ...], stride: tuple[int, ...], offset: int = 0) -> dict[str, Any]:
        parts = (Storage(count), offset, shape, stride, False, OrderedDict())
        return {"w": Call(torch._utils._rebuild_tensor_v2, *parts)}

    legacy = io.BytesIO()
    torch.save({"weight": torch.ones(2)}, legacy, _use_new_zipfile_serialization=False)
    return {
        "compressed": archive(tensor(6 * 2**24, (1,), (1,)), bytes(24 * 2**24), zipfile.ZIP_DEFLATED),
        "storage too large": archive(tensor(10**9, (1,), (1,))),
        "tensor too large": archive(tensor(2, (10**9,), (1,))),
        "stretched": archive(tensor(2, (10**9,), (0,))),
        "before its storage": archive(tensor(2, (1,), (1,), -(10**6))),
        "backwards": archive(tensor(2, (2,), (-1,))),
        "no numbers": archive(tensor(2, (2,), (1,)), b""),
        "code in tensors": archive(Call(Path.mkdir, mark)),
        "old format": legacy.getvalue(),
        "no tensors": b"",
        "noise": np.random.default_rng(0).bytes(5000),
        "an array": archive([1, 2]),
    }


def settings(good: dict[str, Any]) -> dict[str, bytes]:
    """Contents of `data` by what they try."""

    def encoded(value: Any) -> dict[str, str]:
        return {":serialized:": base64.b64encode(pickle.dumps(value)).decode()}

    wide = spaces.Box(-1.0, 1.0, (2,))
    wide._shape = (10**10,)
    bits = spaces.MultiBinary(2)
    bits.n, bits._shape = 10**11, (10**11,)
    many = spaces.Discrete(2)
    many.n = np.int64(10**12)
    large = {
        "wide networks": {"policy_kwargs": {"net_arch": [10**6, 10**6]}},
        "deep networks": {"policy_kwargs": {"net_arch": [1] * 200_000}},
        "embedding": {
            "policy_kwargs": encoded(
                {"features_extractor_class": torch.nn.Embedding, "features_extractor_kwargs": {"embedding_dim": 10**10}}
            )
        },
        "space of another shape": {"observation_space": encoded(wide)},
        "many bits": {"observation_space": encoded(bits)},
        "many actions": {"action_space": encoded(many)},
        "no space": {"observation_space": 3},
        "policy is no policy": {"policy_class": encoded(torch.nn.Linear)},
        "text for numbers": {"gamma": "much", "gae_lambda": [], "max_grad_norm": {}, "sde_sample_freq": "x"},
        "own names": {"__class__": 1, "_setup_model": 2, "set_parameters": 3},
    }
    found = {name: json.dumps({**good, **entry}).encode() for name, entry in large.items()}
    return {
        **found,
        "large number": json.dumps(good).encode()[:-1] + b', "n": 1' + b"0" * 400 + b', "m": ' + b"9" * 6000 + b"}",
        "nested": b'{"a":' * 50_000 + b"1" + b"}" * 50_000,
        "many lists": b'{"policy_class": [' + b"[]," * 15_000_000 + b"1]}",
        "no text": b"\xff\xfe\x00",
        "not a mapping": b"[]",
    }


def write_hostile(good: Path, folder: Path, mark: Path) -> None:
    """Write a `.zip` for each of them, from a good one."""
    with zipfile.ZipFile(good) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])

    def write(name: str, change: dict[str, bytes], compressed: bool = False) -> None:
        kind = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
        with zipfile.ZipFile(folder / f"{name}.zip", "w", kind) as archive:
            for member, content in {**members, **change}.items():
                archive.writestr(member, content)

    for name, content in pickles(mark).items():
        coded = {":serialized:": base64.b64encode(content).decode()}
        write(f"pickle, {name}", {"data": json.dumps({**data, "policy_kwargs": coded}).encode()})
    for name, content in tensor_members(mark).items():
        write(f"tensors, {name}", {"policy.pth": content})
    for name, content in settings(data).items():
        write(f"settings, {name}", {"data": content}, compressed=True)
    write("member, class", {"__class__.pth": members["policy.pth"], "policy.__init__.pth": members["policy.pth"]})
    whole = good.read_bytes()
    for cut in range(8):
        (folder / f"cut, {cut}.zip").write_bytes(whole[: len(whole) * cut // 8])
    noise = np.random.default_rng(1)
    for number in range(12):
        broken = bytearray(whole)
        for place in noise.integers(0, len(whole), 30):
            broken[place] = noise.integers(256)
        (folder / f"broken, {number:02}.zip").write_bytes(bytes(broken))


def outcomes(paths: list[Path], load: Callable[[Path], Any]) -> Iterator[dict[str, Any]]:
    """Yield what became of each file."""
    for path in paths:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            load(path)
            error, message = "", ""
        except Exception as raised:
            error, message = type(raised).__name__, str(raised)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**10
        yield {"file": path.name, "error": error, "message": message, "grown": grown}


def main(folder: str) -> None:
    """Load every file of a folder."""
    from agents import load_ego

    paths = sorted(Path(folder).glob("*.zip"))
    load_ego(paths.pop(0))  # the good one, so that libraries are loaded
    for outcome in outcomes(paths, lambda path: load_ego(path, algo="ppo")):
        print(json.dumps(outcome), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
