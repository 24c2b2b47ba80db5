"""Tensors in a `.pth` member of a saved model, read without torch: its reader follows sizes that the file claims.

The format is that of `torch.save`: a zip archive, stored uncompressed, with a pickle `data.pkl` of mappings and tensors
and one member `data/KEY` for the bytes of each storage. A tensor here is no larger than its storage, a storage as large
as its member, and all members together no larger than the archive.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from agents.sb3.pickle_values import RECONSTRUCTIONS, ForbiddenObject, is_array_shape
from agents.sb3.safe_pickle import RestrictedUnpickler

STORAGE_DTYPES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
"""Names in `torch` to the types of numbers that they stand for."""


class _StorageType(NamedTuple):
    """A name of `STORAGE_DTYPES` in a pickle."""

    dtype: torch.dtype


class _Storage(NamedTuple):
    """Numbers that several tensors may share, one after the other."""

    numbers: Tensor


def read_tensors(content: bytes) -> Any:
    """Return what a `.pth` member holds: mappings, lists, plain values and tensors on the CPU.

    Args:
        content: Of the member.

    Raises:
        ForbiddenObject: It holds something else.
        Exception: It is damaged; anything may be raised.

    Example:
        >>> file = io.BytesIO()
        >>> torch.save({"weight": torch.ones(2)}, file)
        >>> read_tensors(file.getvalue())
        {'weight': tensor([1., 1.])}
    """
    members = _read_members(content)
    names = [name for name in members if name.endswith("/data.pkl")]
    if len(names) != 1:
        raise ValueError("its tensors are not in the format of torch 1.6 and later")
    folder = names[0].removesuffix("data.pkl")
    if members.get(f"{folder}byteorder", b"little") != b"little":
        raise ValueError("its tensors are big-endian")
    return _TensorUnpickler(members[names[0]], members, folder).load()


def _read_members(content: bytes) -> dict[str, bytes]:
    """Return the members of an archive, which are not compressed and do not share bytes.

    Raises:
        ForbiddenObject: They do.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        infos = archive.infolist()
        stored = all(info.compress_type == zipfile.ZIP_STORED for info in infos)
        if not stored or sum(info.file_size for info in infos) > len(content):
            raise ForbiddenObject("its tensors would unpack to more than the file holds")
        return {info.filename: archive.read(info) for info in infos}


def _rebuild_tensor(storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> Tensor:
    """Return a view of a storage; what torch writes behind the strides only training needs."""
    good = isinstance(storage, _Storage) and type(offset) is int and is_array_shape(shape) and is_array_shape(stride)
    if not good or len(shape) != len(stride):
        raise ForbiddenObject("it holds a tensor without its form")
    count = math.prod(shape)
    last = offset + sum((size - 1) * step for size, step in zip(shape, stride, strict=True)) if count else offset
    if not (0 <= offset and count <= storage.numbers.numel() and (not count or last < storage.numbers.numel())):
        raise ForbiddenObject("it holds a tensor larger than its storage")
    tensor: Tensor = storage.numbers.as_strided(shape, stride, offset)
    return tensor


def _rebuild_parameter(tensor: Any, *_: Any) -> Tensor:
    if not isinstance(tensor, Tensor):
        raise ForbiddenObject("it holds a parameter that is no tensor")
    return tensor


class _TensorUnpickler(RestrictedUnpickler):
    """Unpickler of `data.pkl`."""

    reconstructions: ClassVar[dict[str, Callable[..., Any]]] = {
        "collections.OrderedDict": RECONSTRUCTIONS["collections.OrderedDict"],
        "torch._utils._rebuild_tensor_v2": _rebuild_tensor,
        "torch._utils._rebuild_parameter": _rebuild_parameter,
    }

    def __init__(self, pickled: bytes, members: Mapping[str, bytes], folder: str) -> None:
        super().__init__(io.BytesIO(pickled))
        self._members, self._folder = members, folder
        self._storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        """Return what a name stands for, storages included."""
        if module == "torch" and name in STORAGE_DTYPES:
            return _StorageType(STORAGE_DTYPES[name])
        return super().find_class(module, name)

    def find_listed_class(self, module: str, name: str) -> type | None:
        """Return no class: tensors need none."""
        return None

    def persistent_load(self, pid: Any) -> _Storage:
        """Return the storage in a member of the archive."""
        form = type(pid) is tuple and len(pid) == 5 and pid[0] == "storage" and isinstance(pid[1], _StorageType)
        if not form or not isinstance(pid[2], str) or type(pid[4]) is not int:
            raise ForbiddenObject("it refers to something that is no storage")
        _, (dtype,), key, _, count = pid
        if key not in self._storages:
            content = self._members[f"{self._folder}data/{key}"]
            if len(content) != count * dtype.itemsize:
                raise ForbiddenObject("it claims another size of a storage than it has")
            empty = torch.empty(0, dtype=dtype)
            self._storages[key] = _Storage(torch.frombuffer(bytearray(content), dtype=dtype) if count else empty)
        if self._storages[key].numbers.dtype != dtype:
            raise ForbiddenObject("it reads one storage as two types")
        return self._storages[key]
