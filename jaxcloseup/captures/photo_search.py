"""Find the photographs that a capture's files list, though these were moved to another system.

Names may differ in case or in their Unicode form, have backslashes or another ending, or begin with
folders of another computer. What fits several files is not guessed.
"""

import collections
import functools
import os
import pathlib
import re
import unicodedata
from collections.abc import Callable, Sequence
from typing import NamedTuple

from jaxcloseup.captures.photo_files import ENDINGS
from jaxcloseup.captures.photo_masks import list_photographs
from jaxcloseup.captures.reduced_photos import photographs_folder
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.photos.scene import SceneError


IMAGES = "images"
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")  # Blender's files leave them out
_Files = dict[str, list[pathlib.Path]]  # files and folders by their names


class Located(NamedTuple):
    """Frames whose photographs exist, the others, and a note on names that differ."""

    frames: list[Frame]
    missing: list[Frame]
    notes: tuple[str, ...]


def photograph_folders(capture: pathlib.Path, *others: pathlib.Path) -> list[pathlib.Path]:
    """List where photographs may lie: `images` in any case or shrunk, the capture, and others."""
    inner = sorted(path for path in capture.iterdir() if path.name.lower() == IMAGES)
    inner = sorted(inner, key=lambda path: path.name != IMAGES) or [photographs_folder(capture)]
    return list(dict.fromkeys((*filter(pathlib.Path.is_dir, inner), capture, *others)))


def list_first(folders: Sequence[pathlib.Path]) -> tuple[pathlib.Path, list[pathlib.Path]]:
    """Return the first folder that holds photographs, and these, sorted; see `list_photographs`."""
    listed = ((folder, list_photographs(folder)) for folder in folders)
    return next((pair for pair in listed if pair[1]), (folders[0], []))


def locate(
    capture: pathlib.Path, frames: Sequence[Frame], folders: Sequence[pathlib.Path]
) -> Located:
    """Set the file of each frame.

    Args:
      capture: folder of the capture, for notes.
      frames: all photographs that are listed for one folder.
      folders: where they may lie. What lies in the first as it is listed needs no note.

    Raises:
      SceneError: a name fits several files.
    """
    files = {
        name: find_exact(folders[0], name)
        for name in dict.fromkeys(frame.listed for frame in frames)
    }
    others, found = [name for name, file in files.items() if file is None], {}
    index = functools.cache(_index)
    for name in others:
        how, hits = _search(_parts(name), folders, index)
        if len(hits) > 1:
            source = next(frame.source for frame in frames if frame.listed == name)
            raise SceneError(
                f"{source}: {name!r} fits both {hits[0]} and {hits[1]}: remove or rename one of "
                "them, or correct the name."
            )
        if hits:
            found[name] = how, hits[0]
    # One photograph is not two that are listed under different names.
    every = files | {name: file for name, (_, file) in found.items()}
    owners = collections.Counter(
        file for _, file in {(tuple(_parts(name)), file) for name, file in every.items()}
    )
    found = {name: pair for name, pair in found.items() if owners[pair[1]] == 1}
    files |= {name: file for name, (_, file) in found.items()}
    placed = [(frame, files[frame.listed]) for frame in frames]
    return Located(
        [frame._replace(file=file) for frame, file in placed if file],
        [frame for frame, file in placed if not file],
        _notes(capture, [frame.listed for frame in frames], found),
    )


def check_missing(capture: pathlib.Path, located: Located, folders: Sequence[pathlib.Path]) -> None:
    """Raise one `SceneError` for all photographs that are listed but do not exist."""
    if not located.missing:
        return
    source = located.missing[0].source
    names = [frame.listed for frame in located.missing]
    total = sum(frame.source == source for frame in (*located.frames, *located.missing))
    first = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    above = capture.resolve().parent
    places = ", ".join(f"{os.path.relpath(folder.resolve(), above)}/" for folder in folders)
    raise SceneError(
        f"{source}: {len(names)} of {total} listed images do not exist ({first}), nor in another "
        f"case or with another ending in {places}: restore them or remove their frames."
    )


def find_exact(folder: pathlib.Path, listed: str) -> pathlib.Path | None:
    """Find a file as it is listed, with slashes or backslashes; the suffix may be left out."""
    path = folder / listed.replace("\\", "/")
    suffixes = _SUFFIXES[: 1 if path.suffix.lower() in ENDINGS else None]
    candidates = [pathlib.Path(f"{path}{suffix}") for suffix in suffixes]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _parts(listed: str) -> list[str]:
    """Split a name into folders and file, without the parts that name no folder."""
    parts = re.sub(r"^[A-Za-z]:", "", listed.replace("\\", "/")).split("/")
    return [part for part in parts if part not in ("", ".", "..")]


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _stem(name: str) -> str:
    """Return what a photograph is called without its ending, if it has one."""
    return _folded(re.sub(r"\.[A-Za-z]\w{1,4}$", "", name))


def _search(
    parts: Sequence[str],
    folders: Sequence[pathlib.Path],
    index: Callable[[pathlib.Path, Callable[[str], str]], _Files],
) -> tuple[str, list[pathlib.Path]]:
    """Return how a name was found, and all files that fit it in this way."""
    ways: tuple[tuple[Callable[[str], str], str], ...] = (
        (str, "in another folder than listed"),
        (_folded, "under another case or Unicode form of their names"),
        (_stem, "with another ending"),
    )
    for start in range(len(parts)):
        for fold, how in ways:
            hits: dict[pathlib.Path, None] = {}
            for places in ([folder] for folder in folders):
                for part in parts[start:-1]:
                    inner = str if fold is str else _folded
                    places = [at for one in places for at in index(one, inner).get(inner(part), ())]
                last = [at for one in places for at in index(one, fold).get(fold(parts[-1]), ())]
                pictures = (at for at in last if fold is not _stem or at.suffix.lower() in ENDINGS)
                hits |= dict.fromkeys(filter(pathlib.Path.is_file, pictures))
            if hits:
                return how, list(hits)
    return "", []


def _index(folder: pathlib.Path, fold: Callable[[str], str]) -> _Files:
    """List a folder by a function of the names; empty if it is none."""
    found: _Files = {}
    for name in sorted(os.listdir(folder)) if folder.is_dir() else ():
        found.setdefault(fold(name), []).append(folder / name)
    return found


def _notes(
    capture: pathlib.Path, names: Sequence[str], found: dict[str, tuple[str, pathlib.Path]]
) -> tuple[str, ...]:
    """Say how many photographs have other names, by how they were found."""
    by_way: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        if name in found:
            by_way.setdefault(found[name][0], []).append(name)
    return tuple(
        f"{len(same)} photographs were found {how}, such as {same[0]}, which is "
        f"{os.path.relpath(found[same[0]][1], capture)}"
        for how, same in by_way.items()
    )
