"""Split the photographs of a capture into training and held-out ones."""

import collections
import pathlib
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcloseup.captures.depth_range import depths_in_view
from jaxcloseup.captures.json_fields import read_object
from jaxcloseup.captures.photo_files import read_image
from jaxcloseup.captures.world_frames import Frame, frame_intrinsics
from jaxcloseup.photos.scene import DuplicateFileWarning, SceneError, UnknownKeyWarning


TEST_EVERY = 8
CLOSEST_SHARE = 0.1
_LISTS = {"train": "train_filenames", "test": "test_filenames", "test_far": "val_filenames"}
_SPLIT_FILE_KEYS = {"train", "test", "test_far", "unused"}


# Returns frames that list the points they show, and these points `[P, 3]`.
FindPoints = Callable[[Sequence[Frame]], tuple[list[Frame], np.ndarray]]


class Division(NamedTuple):
    """The photographs of a capture by split."""

    frames: dict[str, list[Frame]]  # photographs of each split present, `train` first
    notes: tuple[str, ...] = ()  # sentences on how they were split
    # for `closest`, how many times nearer each `test` photograph is than the median `train` one;
    # for `zoom`, how many times finer each close-up is; otherwise None
    times_nearer: tuple[float, ...] | None = None


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


def divide(
    name: str,
    frames: Sequence[Frame],
    given: dict[str, list[Frame]] | None,
    split: str,
    points: np.ndarray,
    zoom: int = 1,
    *,
    find_points: FindPoints | None = None,
) -> Division:
    """Split the photographs of a capture.

    Args:
      name: name of the capture, for notes.
      frames: all photographs.
      given: splits that the capture's files list, or None.
      split: one of `SPLITS`, see `load_scene`; without lists `given` holds out every 8th, and
        `listed` nothing.
      points: `[P, 3]` world points, which `closest` needs.
      zoom: how many times finer the close-ups of `zoom` are.
      find_points: finds them for `closest` where there are none.

    Raises:
      SceneError: `closest` has too few photographs, or no points that they see.
    """
    if split in ("given", "listed") and given:
        return Division(given)
    frames = sorted({frame.file: frame for frame in frames}.values(), key=lambda f: f.listed)
    if split == "listed":
        note = f"{name} lists no splits: all of its {len(frames)} photographs train, none is scored"
        return Division({"train": frames}, (note,))
    if split == "closest":
        return _closest(name, frames, points, find_points)
    if split == "zoom":
        return _zoom(name, frames, zoom)
    parts = _every_eighth(frames)
    reason = " lists no splits" if split == "given" else ""
    return Division(
        parts,
        (
            f"{name}{reason}: test_far is every {TEST_EVERY}th of its {len(frames)} photographs "
            f"by name, {len(parts.get('test_far', ()))} in all",
        ),
    )


def without_repeats(frames: Sequence[Frame]) -> list[Frame]:
    """Keep the first of the frames that one file lists for one photograph, and warn of others."""
    first: dict[tuple[pathlib.Path, pathlib.Path], Frame] = {}
    repeated = []
    for frame in frames:
        if first.setdefault((frame.source, frame.file), frame) is not frame:
            repeated.append(frame)
    if repeated:
        names = list(dict.fromkeys(frame.listed for frame in repeated))
        kept = [first[frame.source, frame.file].camtoworld for frame in repeated]
        pairs = zip(repeated, kept, strict=True)
        differ = any((frame.camtoworld != pose).any() for frame, pose in pairs)
        warnings.warn(
            f"{repeated[0].source} lists {_some(names)} in more than one frame"
            f"{', with different poses' if differ else ''}: the first frame of each is used.",
            DuplicateFileWarning,
            stacklevel=2,
        )
    return list(first.values())


def warn_duplicates(folder: pathlib.Path, splits: dict[str, list[Frame]]) -> None:
    """Warn about photographs that are in more than one split."""
    seen: dict[pathlib.Path, str] = {}
    repeated = []
    for split, members in splits.items():
        for frame in members:
            if frame.file in seen:
                repeated.append(f"{frame.listed} ({seen[frame.file]} and {split})")
            seen.setdefault(frame.file, split)
    if repeated:
        warnings.warn(
            f"{folder} lists {len(repeated)} photographs more than once: {_some(repeated)}; a "
            "score on a training photograph says nothing about new views.",
            DuplicateFileWarning,
            stacklevel=2,
        )


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _every_eighth(frames: Sequence[Frame]) -> dict[str, list[Frame]]:
    if len(frames) == 1:
        return {"train": list(frames)}
    return {
        "train": [frame for i, frame in enumerate(frames) if i % TEST_EVERY],
        "test_far": [frame for i, frame in enumerate(frames) if i % TEST_EVERY == 0],
    }


def _closest(
    name: str, frames: Sequence[Frame], points: np.ndarray, find_points: FindPoints | None
) -> Division:
    if len(frames) < 2:
        raise SceneError(f"{name}: split closest needs at least 2 photographs, got 1: add some.")
    showing, by = frames, ""
    if not len(points) and find_points:
        showing, points = find_points(frames)
        by = f" by {len(points)} points triangulated from their features"
    sizes = [_size_of_pixel(frame, points) for frame in showing]
    if not np.isfinite(sizes).any():
        raise SceneError(
            f"{name}: split closest needs points that the photographs see, but the capture lists "
            "none and the photographs' features give none: read its COLMAP model "
            "(--format=colmap), give ply_file_path, or choose --split=zoom, which needs no points."
        )
    nearest = np.argsort(sizes, kind="stable")[: max(1, round(CLOSEST_SHARE * len(frames)))]
    held_out = sorted(nearest.tolist())
    rest = [frame for i, frame in enumerate(frames) if i not in held_out]
    parts = _every_eighth(rest)
    parts = {"train": parts["train"], "test": [frames[i] for i in held_out], **parts}
    size_by_file = {frame.file: size for frame, size in zip(frames, sizes, strict=True)}
    median = np.median([size_by_file[frame.file] for frame in parts["train"]])
    ratios = tuple(float(median / sizes[i]) for i in held_out)
    note = (
        f"{name}: test is the {len(held_out)} nearest of {len(frames)} photographs{by}, "
        f"{min(ratios):.2f} to {max(ratios):.2f} times nearer (median {np.median(ratios):.2f}) "
        f"than the median of {len(parts['train'])} training photographs; test_far is "
        f"{len(parts.get('test_far', ()))} others"
    )
    return Division(parts, (note,), ratios)


def _zoom(name: str, frames: Sequence[Frame], zoom: int) -> Division:
    parts = _every_eighth(frames)
    train, test = parts["train"], parts["train"][::TEST_EVERY]
    note = (
        f"{name}: its {len(train)} training photographs shrink {zoom} times; test is the most "
        f"detailed crop of every {TEST_EVERY}th of them, unshrunk, {len(test)} in all, {zoom} "
        f"times finer from the same positions; test_far is {len(parts.get('test_far', ()))} others"
    )
    return Division({"train": train, "test": test, **parts}, (note,), (float(zoom),) * len(test))


def _size_of_pixel(frame: Frame, points: np.ndarray) -> float:
    """Return the median world size of a full-size pixel at the points seen; inf without."""
    size = frame.size or read_image(frame.file).shape[1::-1]
    intrinsics = frame_intrinsics(frame, *size)
    if frame.seen is None:
        depths = depths_in_view(points, frame.camtoworld, intrinsics, size)
    else:
        depths = (points[frame.seen] - frame.camtoworld[:, 3]) @ frame.camtoworld[:, 2]
        depths = depths[depths > 0]
    return (
        float(np.median(depths) / np.sqrt(intrinsics[0] * intrinsics[1])) if len(depths) else np.inf
    )


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
