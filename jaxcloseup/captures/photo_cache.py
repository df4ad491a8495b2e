"""Cache shrunk photographs on disk, because decoding large ones dominates loading time.

The cache is `$XDG_CACHE_HOME/jaxcloseup/photographs`. Each file is named by a hash of everything
that determines it, so no file is ever out of date, and any file may be deleted.
"""

import contextlib
import hashlib
import io
import logging
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from jaxcloseup.io.files import cache_folder, read_bytes, write_file


_DIGEST = 32  # bytes of SHA-256 in front of the content
_LARGEST = 2**32  # bytes

_log = logging.getLogger(__name__)
_T = TypeVar("_T")


def content_hash(data: bytes | np.ndarray | None) -> str | None:
    """Hash the content of a file; None stays None."""
    return None if data is None else hashlib.sha256(data).hexdigest()


def cached(
    key: str,
    make: Callable[[], dict[str, np.ndarray]],
    read: Callable[[dict[str, np.ndarray]], _T],
) -> _T:
    """Read `make()`, or its result from the cache if the same `key` was made before.

    A damaged file is reported and made again. If the cache cannot be written, nothing is cached.

    Args:
      key: everything that determines the result.
      make: returns the arrays to cache.
      read: converts the arrays; raises for other ones.
    """
    name = hashlib.sha256(key.encode()).hexdigest()
    path = cache_folder() / "jaxcloseup" / "photographs" / f"{name}.photo"
    try:
        data = read_bytes(path, most=_LARGEST)
        if hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
            raise ValueError("its hash is another one")
        return read(dict(np.load(io.BytesIO(data[_DIGEST:]), allow_pickle=False)))
    except FileNotFoundError:
        pass
    except Exception as error:  # damage can fail in any way
        _log.warning("%s is damaged (%s) and made again", path, type(error).__name__)
    made = make()
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **made)
    with contextlib.suppress(OSError):
        write_file(path, hashlib.sha256(file.getbuffer()).digest() + file.getbuffer())
    return read(made)
