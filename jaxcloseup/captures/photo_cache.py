"""Reduced photographs on disk: to decode large ones takes most of the time that loading takes.

They lie in `$XDG_CACHE_HOME/jaxcloseup/photographs` under the hash of all that makes them, so that
nothing there is ever out of date, and anything may be deleted.
"""

import contextlib
import hashlib
import io
from collections.abc import Callable

import numpy as np

from jaxcloseup.files import cache_folder, write_file


_DIGEST = 32  # bytes of SHA-256, before the content that they are of


def content_hash(data: bytes | np.ndarray | None) -> str | None:
    """A name for the content of a file, or None for that of no file."""
    return None if data is None else hashlib.sha256(data).hexdigest()


def kept(key: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """`make()`, from disk where it was made for the same `key` before.

    What is damaged there is made again, and what cannot be written is not kept.
    """
    name = hashlib.sha256(key.encode()).hexdigest()
    path = cache_folder() / "jaxcloseup" / "photographs" / f"{name}.photo"
    with contextlib.suppress(OSError):
        data = path.read_bytes()
        if hashlib.sha256(data[_DIGEST:]).digest() == data[:_DIGEST]:
            return dict(np.load(io.BytesIO(data[_DIGEST:]), allow_pickle=False))
    made = make()
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **made)
    with contextlib.suppress(OSError):
        write_file(path, hashlib.sha256(file.getbuffer()).digest() + file.getbuffer())
    return made
