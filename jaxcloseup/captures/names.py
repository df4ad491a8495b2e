"""Name photographs, for renders and reports."""

import collections
import hashlib
import os
import pathlib
from collections.abc import Sequence

from jaxcloseup.io.messages import is_control


_LONGEST_NAME = 120  # bytes; files of renders add to it, and may have 255


def unique_names(files: Sequence[pathlib.Path]) -> list[str]:
    """Name each file by its stem; prefix the folder's name, then number, where names clash.

    Names are of printable characters, and longer ones than `_LONGEST_NAME` end in a hash.
    """
    stems = collections.Counter(file.stem for file in files)
    names: dict[str, None] = {}
    repeats: dict[str, int] = {}  # the last number of each name
    for file in files:
        stem = file.stem
        name = base = _name(stem if stems[stem] == 1 else f"{file.parent.name}_{stem}")
        while name in names:
            repeats[base] = repeats.get(base, 1) + 1
            name = f"{base}_{repeats[base]}"
        names[name] = None
    return list(names)


def file_names(files: Sequence[pathlib.Path]) -> list[str]:
    """Name each file by its name; where names repeat, by its path in the folder of all files."""
    counts = collections.Counter(file.name for file in files)
    if len(counts) == len(files):
        return [file.name for file in files]
    root = os.path.commonpath([os.path.abspath(file.parent) for file in files])
    return [
        file.name
        if counts[file.name] == 1
        else pathlib.Path(os.path.relpath(file, root)).as_posix()
        for file in files
    ]


def _name(text: str) -> str:
    """Replace what cannot be printed, and shorten the name."""
    plain = "".join("_" if is_control(character) else character for character in text)
    data = plain.encode()
    if len(data) <= _LONGEST_NAME:
        return plain
    digest = hashlib.sha256(data).hexdigest()[:8]
    return f"{data[: _LONGEST_NAME - 9].decode(errors='ignore')}_{digest}"
