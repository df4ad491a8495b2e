"""Keep named arrays and a JSON record in a file under a key, so that they are made only once.

A file holds the SHA-256 of the rest, then a zip archive as `np.savez` writes it with one more
entry, `about.json`. The hash finds damage that the checksums inside of the archive do not cover.
"""

import hashlib
import json
import pathlib
import zipfile
from collections.abc import Callable, Iterable, Mapping
from typing import Any, BinaryIO, NamedTuple, TypeVar

import numpy as np

from jaxcloseup.io.files import cache_folder, check_file, writing


LARGEST = 2**32  # bytes of a file, also unpacked
_ABOUT = "about.json"
_DIGEST = hashlib.sha256().digest_size

_T = TypeVar("_T")


class Stored(NamedTuple):
    """The content of a file."""

    arrays: Mapping[str, np.ndarray]  # arrays by name
    record: Any = None  # any JSON value


def cached(
    path: str | pathlib.Path,
    key: str,
    make: Callable[[], _T],
    *,
    pack: Callable[[_T], Stored],
    unpack: Callable[[Stored], _T],
    level: int = 0,
    report: Callable[[str], object],
    report_unwritable: Callable[[str], object] | None = None,
) -> _T:
    """Return what a file keeps under a key; otherwise make it and keep it there.

    A damaged or foreign file is reported and made again. A file with another key is made again.

    Args:
      path: path of the file.
      key: everything that determines the value, for example a hash.
      make: returns the value.
      pack: converts a value to what the file holds.
      unpack: converts it back; raises an exception for anything that `pack` does not return.
      level: 0 stores arrays as they are, 1 (fast) to 9 (small) compress them.
      report: receives a sentence about a damaged file.
      report_unwritable: receives a sentence if the file cannot be written; by default `report`.
    """
    try:
        stored = load(path, key)
        if stored is not None:
            return unpack(stored)
    except Exception as error:  # damage can fail in any way
        report(f"{path} is damaged ({type(error).__name__}) and is made again")
    value = make()
    try:
        save(path, key, pack(value), level=level)
    except OSError as error:
        (report_unwritable or report)(f"the result is made again next time: {error}")
    return value


def save(path: str | pathlib.Path, key: str, stored: Stored, *, level: int = 0) -> None:
    """Write arrays and a record under a key, whole or not at all; `cached` explains `level`.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    with writing(path) as file:
        file.write(bytes(_DIGEST))
        with zipfile.ZipFile(file, "w", method, compresslevel=level or None) as archive:
            # Unlike `writestr`, `open` writes no time, so equal values make equal files.
            with archive.open(_ABOUT, "w") as entry:
                entry.write(json.dumps({"key": key, "record": stored.record}).encode())
            for name, array in stored.arrays.items():
                # The size is unknown before, and may exceed what a plain zip entry can hold.
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asarray(array), allow_pickle=False)
        file.seek(_DIGEST)
        digest = hashlib.file_digest(file, "sha256").digest()
        file.seek(0)
        file.write(digest)


def load(path: str | pathlib.Path, key: str, *, most: int = LARGEST) -> Stored | None:
    """Read what `save` wrote; return None if there is no file, or only one with another key.

    Raises:
      Exception: the file is damaged, foreign, or has more than `most` bytes.
    """
    try:
        check_file(path, most=most)
    except (FileNotFoundError, NotADirectoryError):
        return None
    with open(path, "rb") as file:
        digest = file.read(_DIGEST)
        if hashlib.file_digest(file, "sha256").digest() != digest:
            raise ValueError("the hash of the file is another one")
        return _read_archive(file, key, most)


def _read_archive(file: BinaryIO, key: str, most: int) -> Stored | None:
    # An archive may stand behind other bytes.
    with zipfile.ZipFile(file) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > most:
            raise ValueError(f"unpacked, the file has more than {most} bytes")
        about = json.loads(archive.read(_ABOUT))
        if about["key"] != key:
            return None
        arrays = {}
        for name in archive.namelist():
            if name != _ABOUT:
                with archive.open(name) as entry:
                    array = np.lib.format.read_array(entry, allow_pickle=False)
                arrays[name.removesuffix(".npy")] = array
    return Stored(arrays, about["record"])


def cache_path(*parts: str) -> pathlib.Path:
    """Return a path inside of the user's folder for files that this package can make again."""
    return cache_folder().joinpath("jaxcloseup", *parts)


def content_hash(data: bytes | np.ndarray) -> str:
    """Return the SHA-256 of some bytes, or of the values of an array, in hexadecimal."""
    return hashlib.sha256(data.data if isinstance(data, np.ndarray) else data).hexdigest()


def hash_files(files: Iterable[pathlib.Path]) -> str:
    """Return the SHA-256 of the contents of files, such as of the code that makes a value."""
    return content_hash(b"".join(content_hash(file.read_bytes()).encode() for file in files))
