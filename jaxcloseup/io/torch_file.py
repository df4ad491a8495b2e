"""Read tensors from PyTorch's files without PyTorch, in the zip format and the legacy format.

Both hold a pickle that names types and storages. The reader builds only tensors, containers and
numbers, so a file cannot run code.
"""

import collections
import io
import math
import pathlib
import pickle
import struct
import zipfile
from collections.abc import Callable
from typing import IO, Any

import numpy as np

from jaxcloseup.io.files import LARGEST, check_file
from jaxcloseup.io.messages import printable, reason


LARGEST_FILE = LARGEST  # bytes, also unpacked; the largest known file of weights has 528 MiB
_TYPES: dict[str, np.dtype] = {
    "FloatStorage": np.dtype(np.float32),
    "DoubleStorage": np.dtype(np.float64),
    "HalfStorage": np.dtype(np.float16),
    "LongStorage": np.dtype(np.int64),
    "IntStorage": np.dtype(np.int32),
}
# The first two pickles of a legacy file (before PyTorch 1.6): magic number and version.
_MAGIC = 0x1950A86A20F9469CFC6C
_VERSION = 1001


class TorchFileError(Exception):
    """A file holds no readable tensors. The message is one sentence that says what to do."""

    def __init__(self, message: str) -> None:
        """Escape what a terminal would obey in what files say."""
        super().__init__(printable(message))


def read_tensors(path: str | pathlib.Path) -> dict[str, np.ndarray]:
    """Read the tensors, by name, of a state dictionary that `torch.save` wrote.

    Raises:
      TorchFileError: the file is missing, truncated or larger than `LARGEST_FILE`, or does not hold
        named tensors.
    """
    path = pathlib.Path(path)
    try:
        check_file(path, most=LARGEST_FILE)
        read = _read_zip if zipfile.is_zipfile(path) else _read_legacy
        found = read(path)
    except OSError as error:
        raise TorchFileError(f"{path} cannot be read ({error.strerror}): restore it.") from error
    except Exception as error:  # a damaged pickle can fail in any way
        raise TorchFileError(
            f"{path} is not a whole file of PyTorch tensors ({reason(error)}): download it again."
        ) from error
    tensors = isinstance(found, dict) and all(
        isinstance(name, str) and isinstance(value, np.ndarray) for name, value in found.items()
    )
    if not tensors:
        raise TorchFileError(f"{path} is not a dictionary of tensors: name a file of weights.")
    return dict(found)


def _read_zip(path: pathlib.Path) -> Any:
    with zipfile.ZipFile(path) as archive:
        if sum(part.file_size for part in archive.infolist()) > LARGEST_FILE:
            raise ValueError(f"unpacked, it has more than {LARGEST_FILE >> 20} MiB")
        inner = next(name for name in archive.namelist() if name.endswith("data.pkl"))
        root = inner.removesuffix("data.pkl")

        def load(kind: _Kind, key: str) -> _Storage:
            return _Storage(np.frombuffer(archive.read(f"{root}data/{key}"), kind.dtype))

        return _built(_Unpickler(io.BytesIO(archive.read(inner)), load).load())


def _read_legacy(path: pathlib.Path) -> Any:
    with path.open("rb") as file:
        storages: dict[str, _Storage] = {}

        def later(kind: _Kind, key: str) -> _Storage:
            # The numbers follow the pickle, so tensors are built after it.
            return storages.setdefault(key, _Storage(np.zeros(0, kind.dtype)))

        if _Unpickler(file, later).load() != _MAGIC or _Unpickler(file, later).load() != _VERSION:
            raise ValueError("its magic number is not PyTorch's")
        _Unpickler(file, later).load()  # sizes of the writer's integers
        value = _Unpickler(file, later).load()
        for key in _Unpickler(file, later).load():
            (count,) = struct.unpack("<q", file.read(8))
            kind = storages[key].numbers.dtype
            if not 0 <= count <= LARGEST_FILE:
                raise ValueError(f"a storage claims {count} numbers")
            storages[key].numbers = np.frombuffer(file.read(count * kind.itemsize), kind, count)
    return _built(value)


def _built(value: Any) -> Any:
    """Build the tensors of a dictionary, once their storages are read."""
    if not isinstance(value, dict):
        return value
    return {
        name: _array(item) if isinstance(item, _Tensor) else item for name, item in value.items()
    }


class _Kind:
    """The type of a storage; nothing that a pickle could call."""

    def __init__(self, dtype: np.dtype) -> None:
        self.dtype = dtype


class _Storage:
    """Numbers that tensors share."""

    def __init__(self, numbers: np.ndarray) -> None:
        self.numbers = numbers


class _Tensor:
    """A part of a storage, whose numbers may not have been read yet."""

    # A pickle calls this with anything, which `_array` checks.
    def __init__(self, storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> None:
        self.storage, self.offset, self.shape, self.strides = storage, offset, shape, strides


def _array(tensor: _Tensor) -> np.ndarray:
    """Copy a tensor to an array.

    A pickle may set any attribute to anything that it can build, so this believes none of them.
    """
    numbers, form = tensor.storage.numbers, (tensor.offset, *tensor.shape, *tensor.strides)
    # NumPy's integers would overflow silently in the check of bounds.
    if not isinstance(numbers, np.ndarray) or any(type(n) is not int or n < 0 for n in form):
        raise ValueError("a tensor's shape is not of whole numbers")
    rank = len(form) // 2
    offset, shape, strides = form[0], form[1 : rank + 1], form[rank + 1 :]
    if len(shape) != len(strides):
        raise ValueError("a tensor's shape and strides do not match")
    if 0 in shape:
        return np.zeros(shape, numbers.dtype)
    last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
    if last >= numbers.size or math.prod(shape) > numbers.size:
        raise ValueError("a tensor reaches beyond its storage")
    steps = [step * numbers.itemsize for step in strides]
    return np.lib.stride_tricks.as_strided(numbers[offset:], shape, steps).copy()


def _parameter(tensor: Any, *_: Any) -> Any:
    return tensor


class _Unpickler(pickle.Unpickler):
    """Builds tensors, dictionaries and numbers, and refuses anything else."""

    def __init__(self, file: IO[bytes], load: Callable[[_Kind, str], _Storage]) -> None:
        super().__init__(file, encoding="utf-8")
        self._load = load

    def find_class(self, module: str, name: str) -> Any:
        """Return the function or type behind a name, if a pickle may use it."""
        known = {
            ("collections", "OrderedDict"): collections.OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): _Tensor,
            ("torch._utils", "_rebuild_parameter"): _parameter,
        }
        if module == "torch" and name in _TYPES:
            return _Kind(_TYPES[name])
        if (module, name) not in known:
            raise pickle.UnpicklingError(f"it holds {module}.{name}")
        return known[module, name]

    def persistent_load(self, pid: Any) -> Any:
        """Return the storage with the type and key in `pid`."""
        _, kind, key, *_ = pid
        if not isinstance(kind, _Kind) or not isinstance(key, str):
            raise pickle.UnpicklingError("a storage has no type or no name")
        return self._load(kind, key)
