"""Which photographs of a folder are trained on and which are held out."""

import logging
import pathlib
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

from jaxcloseup.scenes.errors import DuplicateFileWarning, SceneError
from jaxcloseup.scenes.transforms import Frame, read_transforms


_log = logging.getLogger(__name__)

TEST_EVERY = 8
_FILES = {
    "train": ("transforms_train.json",),
    "test": ("transforms_test.json",),
    "test_far": ("transforms_test_far.json", "transforms_val.json"),
}
_LISTS = {"train": "train_filenames", "test": "test_filenames", "test_far": "val_filenames"}


class Listing(NamedTuple):
    """What a folder lists.

    Attributes:
      file: the file that speaks for the whole capture.
      fields: its fields.
      frames: for each split present the photographs, `train` first.
    """

    file: pathlib.Path
    fields: dict[str, Any]
    frames: dict[str, list[Frame]]


def read_listing(folder: pathlib.Path) -> Listing:
    """The photographs of a folder by split; `load_scene` documents the formats.

    Raises:
      SceneError: no known file in the folder, or something wrong in one.
    """
    separate, single = folder / "transforms_train.json", folder / "transforms.json"
    if separate.is_file():
        if single.is_file():
            _log.info("%s: reading %s and not %s", folder, separate.name, single.name)
        found = {
            split: next((folder / name for name in names if (folder / name).is_file()), None)
            for split, names in _FILES.items()
        }
        read = {split: read_transforms(file) for split, file in found.items() if file}
        listing = Listing(
            separate, read["train"][0], {split: frames for split, (_, frames) in read.items()}
        )
    elif single.is_file():
        fields, frames = read_transforms(single)
        listing = Listing(single, fields, _divide(single, fields, frames))
    else:
        raise SceneError(
            f"{folder} holds no capture: neither {separate.name} nor {single.name} is in it."
        )
    _warn_duplicates(listing)
    return listing


def unique_names(files: Sequence[pathlib.Path]) -> list[str]:
    """A name for each file: its stem; where stems clash, its folder's name before it and so on."""
    stems = [file.stem for file in files]
    names = []
    for file, stem in zip(files, stems, strict=True):
        name = base = stem if stems.count(stem) == 1 else f"{file.parent.name}_{stem}"
        repeat = 1
        while name in names:
            repeat += 1
            name = f"{base}_{repeat}"
        names.append(name)
    return names


def _divide(
    file: pathlib.Path, fields: dict[str, Any], frames: list[Frame]
) -> dict[str, list[Frame]]:
    """The splits that a single file lists, or else every 8th photograph held out."""
    lists = {split: fields[key] for split, key in _LISTS.items() if fields.get(key)}
    if not lists:
        frames = sorted(frames, key=lambda frame: frame.listed)
        train = [frame for i, frame in enumerate(frames) if i % TEST_EVERY or len(frames) == 1]
        held_out = [frame for i, frame in enumerate(frames) if i % TEST_EVERY == 0]
        if len(frames) == 1:
            return {"train": train}
        _log.info(
            "%s lists no splits: every %dth of its %d photographs by name, %d in all, is test_far",
            *(file, TEST_EVERY, len(frames), len(held_out)),
        )
        return {"train": train, "test_far": held_out}
    by_path = {pathlib.PurePath(frame.listed): frame for frame in frames}
    splits = {}
    for split, names in lists.items():
        key = _LISTS[split]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise SceneError(f"{file}: {key} must be a list of the frames' file_path: correct it.")
        unlisted = [name for name in names if pathlib.PurePath(name) not in by_path]
        if unlisted:
            raise SceneError(
                f"{file}: {key} names {unlisted[0]!r}, which no frame has as its file_path "
                f"({len(unlisted)} of {len(names)} such names): correct it."
            )
        splits[split] = [by_path[pathlib.PurePath(name)] for name in names]
    if "train" not in splits:
        held_out = {frame.file for members in splits.values() for frame in members}
        train = [frame for frame in frames if frame.file not in held_out]
        if not train:
            raise SceneError(f"{file}: every frame is held out: leave some for train_filenames.")
        splits = {"train": train, **splits}
    return splits


def _warn_duplicates(listing: Listing) -> None:
    seen: dict[pathlib.Path, str] = {}
    repeated = []
    for split, members in listing.frames.items():
        for frame in members:
            if frame.file in seen:
                repeated.append(f"{frame.listed} ({seen[frame.file]} and {split})")
            seen.setdefault(frame.file, split)
    if repeated:
        more = ", ..." if len(repeated) > 3 else ""
        warnings.warn(
            f"{listing.file.parent} lists {len(repeated)} photographs again: "
            f"{', '.join(repeated[:3])}{more}; a score on a photograph that was trained on says "
            "nothing about new views.",
            DuplicateFileWarning,
            stacklevel=2,
        )
