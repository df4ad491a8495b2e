"""Reading tensors out of PyTorch's files without PyTorch: the zip format and the one before it.

Both hold a pickle that names types and storages; here only tensors, containers and numbers are
built, so a file can run no code.
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
# The first two pickles of a file of before PyTorch 1.6: its mark and its version.
_MAGIC = 0x1950A86A20F9469CFC6C
_VERSION = 1001


class TorchFileError(Exception):
    """A file that holds no readable tensors. The message is one sentence that says what to do."""


def read_tensors(path: str | pathlib.Path) -> dict[str, np.ndarray]:
    """The tensors of a state dictionary that `torch.save` wrote, by name.

    Raises:
      TorchFileError: the file is missing, truncated, or something other than named tensors.
    """
    path = pathlib.Path(path)
    try:
        read = _read_zip if zipfile.is_zipfile(path) else _read_legacy
        found = read(path)
    except OSError as error:
        raise TorchFileError(f"{path} cannot be read ({error.strerror}): restore it.") from error
    except Exception as error:  # a pickle that is cut or strange may fail in any way
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
            # The numbers stand behind the pickle: tensors are made when these are known.
            kinds[key] = kind
            return key

        if _Unpickler(file, later).load() != _MAGIC or _Unpickler(file, later).load() != _VERSION:
            raise ValueError("no mark of PyTorch")
        _Unpickler(file, later).load()  # sizes of the writer's integers
        found = _Unpickler(file, later).load()
        for key in _Unpickler(file, later).load():
            (count,) = struct.unpack("<q", file.read(8))
            kind = np.dtype(kinds[key])
            storages[key] = np.frombuffer(file.read(count * kind.itemsize), kind, count)
    return {name: _view(storages[of.storage], *of.form) for name, of in found.items()}


class _Pending(collections.namedtuple("_Pending", "storage form")):
    """A tensor whose numbers are not read yet."""


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
    """Builds tensors, dictionaries and numbers, and refuses everything else."""

    def __init__(self, file, load):
        super().__init__(file, encoding="utf-8")
        self._load = load

    def find_class(self, module: str, name: str) -> Any:
        """What a pickle may name."""
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
        """A storage, by its kind and key."""
        _, kind, key, *_ = pid
        return self._load(kind, key)
