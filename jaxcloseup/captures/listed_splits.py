"""Splits that the files of a capture list."""

import collections
import pathlib
import warnings
from collections.abc import Callable, Sequence
from typing import Any

from jaxcloseup.captures.json_fields import read_object
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.photos.scene import SceneError, UnknownKeyWarning


_LISTS = {"train": "train_filenames", "test": "test_filenames", "test_far": "val_filenames"}
_SPLIT_FILE_KEYS = {"train", "test", "test_far", "unused"}


def splits_from_fields(
    file: pathlib.Path, fields: dict[str, Any], frames: Sequence[Frame]
) -> dict[str, list[Frame]] | None:
    """Read the splits that the fields of a `transforms.json` list; None without lists."""
    lists = {key: (split, fields[key]) for split, key in _LISTS.items() if fields.get(key)}
    by_path = {pathlib.PurePath(frame.listed): frame for frame in frames}
    chosen = _choose(file, lists, lambda name: by_path.get(pathlib.PurePath(name)), "file_path")
    return _with_train(file, chosen, frames) if chosen else None


def splits_from_file(
    folder: pathlib.Path, frames: Sequence[Frame]
) -> dict[str, list[Frame]] | None:
    """Read the splits of a folder's `split.json`; None if it does not exist.

    The file is an object with lists of photograph names: `train`, `test`, `test_far` and `unused`.
    Photographs that no list names are unused, or form `train` if that list is missing.

    Raises:
      SceneError: the file is not such an object, or a list names an unknown photograph.
    """
    file = folder / "split.json"
    if not file.is_file():
        return None
    fields = read_object(file, "lists train and test")
    if unknown := sorted(set(fields) - _SPLIT_FILE_KEYS):
        warnings.warn(
            f"{file}: these fields are ignored: {', '.join(unknown)}.",
            UnknownKeyWarning,
            stacklevel=2,
        )
    # A bare name that photographs in several folders share is ambiguous.
    bases = collections.Counter(frame.file.name for frame in frames)
    by_name = {frame.file.name: frame for frame in frames if bases[frame.file.name] == 1}
    by_name |= {frame.listed: frame for frame in frames}
    lists = {key: (key, fields[key]) for key in fields if key in _SPLIT_FILE_KEYS and fields[key]}
    chosen = _choose(file, lists, by_name.get, "name")
    splits = _with_train(file, chosen, frames)
    return {key: splits[key] for key in _LISTS if key in splits}


def _choose(
    file: pathlib.Path,
    lists: dict[str, tuple[str, Any]],
    find: Callable[[str], Frame | None],
    field: str,
) -> dict[str, list[Frame]]:
    splits = {}
    for key, (split, names) in lists.items():
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise SceneError(f"{file}: {key} must be a list of the frames' {field}: correct it.")
        members = {name: find(name) for name in names}
        unlisted = [name for name in names if members[name] is None]
        if unlisted:
            raise SceneError(
                f"{file}: {key} names {unlisted[0]!r}, which is no frame's {field} "
                f"({len(unlisted)} of {len(names)} such names): correct it."
            )
        chosen = (frame for frame in members.values() if frame is not None)
        splits[split] = list({frame.file: frame for frame in chosen}.values())
    return splits


def _with_train(
    file: pathlib.Path, splits: dict[str, list[Frame]], frames: Sequence[Frame]
) -> dict[str, list[Frame]]:
    if "train" in splits:
        return splits
    held_out = {frame.file for members in splits.values() for frame in members}
    train = [frame for frame in frames if frame.file not in held_out]
    if not train:
        raise SceneError(f"{file}: every frame is held out: leave some for {_train_key(file)}.")
    return {"train": train, **splits}


def _train_key(file: pathlib.Path) -> str:
    return "train" if file.name == "split.json" else _LISTS["train"]
