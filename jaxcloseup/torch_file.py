"""Read tensors from PyTorch's files without PyTorch, in the zip format and the legacy format.

Both hold a pickle that names types and storages. The reader builds only tensors, containers and
numbers, so a file cannot run code.
"""

import collections
import io
import pathlib
import pickle
import struct
import zipfile
from typing import Any

import numpy as np


_TYPES = {
    "FloatStorage": np.float32,
    "DoubleStorage": np.float64,
    "HalfStorage": np.float16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
}
# The first two pickles of a legacy file (before PyTorch 1.6): magic number and version.
_MAGIC = 0x1950A86A20F9469CFC6C
_VERSION = 1001


class TorchFileError(Exception):
    """A file holds no readable tensors. The message is one sentence that says what to do."""


def read_tensors(path: str | pathlib.Path) -> dict[str, np.ndarray]:
    """Read the tensors, by name, of a state dictionary that `torch.save` wrote.

    Raises:
      TorchFileError: the file is missing or truncated, or does not hold named tensors.
    """
    path = pathlib.Path(path)
    try:
        read = _read_zip if zipfile.is_zipfile(path) else _read_legacy
        found = read(path)
    except OSError as error:
        raise TorchFileError(f"{path} cannot be read ({error.strerror}): restore it.") from error
    except Exception as error:  # a damaged pickle can fail in any way
        raise TorchFileError(
            f"{path} is not a whole file of PyTorch tensors ({error}): download it again."
        ) from error
    tensors = isinstance(found, dict) and all(isinstance(v, np.ndarray) for v in found.values())
    if not tensors:
        raise TorchFileError(f"{path} is not a dictionary of tensors: name a file of weights.")
    return dict(found)


def _read_zip(path):
    with zipfile.ZipFile(path) as archive:
        inner = next(name for name in archive.namelist() if name.endswith("data.pkl"))
        root = inner.removesuffix("data.pkl")

        def load(kind, key):
            return np.frombuffer(archive.read(f"{root}data/{key}"), kind)

        return _Unpickler(io.BytesIO(archive.read(inner)), load).load()


def _read_legacy(path):
    with path.open("rb") as file:
        storages: dict[str, np.ndarray] = {}
        kinds: dict[str, Any] = {}

        def later(kind, key):
            # The numbers follow the pickle, so tensors are built after it.
            kinds[key] = kind
            return key

        if _Unpickler(file, later).load() != _MAGIC or _Unpickler(file, later).load() != _VERSION:
            raise ValueError("its magic number is not PyTorch's")
        _Unpickler(file, later).load()  # sizes of the writer's integers
        found = _Unpickler(file, later).load()
        for key in _Unpickler(file, later).load():
            (count,) = struct.unpack("<q", file.read(8))
            kind = np.dtype(kinds[key])
            storages[key] = np.frombuffer(file.read(count * kind.itemsize), kind, count)
    return {name: _view(storages[tensor.storage], *tensor.form) for name, tensor in found.items()}


class _Pending(collections.namedtuple("_Pending", "storage form")):
    """A tensor whose numbers have not been read yet."""


def _view(storage, offset, shape, strides):
    if not all(map(int, shape)):
        return np.zeros(shape, storage.dtype)
    last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
    if min((offset, *strides), default=0) < 0 or last >= storage.size:
        raise ValueError("a tensor reaches beyond its storage")
    strides = [step * storage.itemsize for step in strides]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, strides).copy()


def _tensor(storage, offset, shape, strides, *_):
    form = offset, shape, strides
    return _Pending(storage, form) if isinstance(storage, str) else _view(storage, *form)


def _parameter(tensor, *_):
    return tensor


class _Unpickler(pickle.Unpickler):
    """Builds tensors, dictionaries and numbers, and refuses anything else."""

    def __init__(self, file, load):
        super().__init__(file, encoding="utf-8")
        self._load = load

    def find_class(self, module: str, name: str) -> Any:
        """The function or type behind a name, if a pickle may use it."""
        known = {
            ("collections", "OrderedDict"): collections.OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch._utils", "_rebuild_parameter"): _parameter,
        }
        if module == "torch" and name in _TYPES:
            return _TYPES[name]
        if (module, name) not in known:
            raise pickle.UnpicklingError(f"it holds {module}.{name}")
        return known[module, name]

    def persistent_load(self, pid: Any) -> Any:
        """The storage with the type and key in `pid`."""
        _, kind, key, *_ = pid
        return self._load(kind, key)
