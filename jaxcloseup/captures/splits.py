"""Split the photographs of a capture into training and held-out ones."""

import pathlib
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from jaxcloseup.captures.choosing import choose_photographs
from jaxcloseup.captures.depth_range import depths_in_view
from jaxcloseup.captures.photo_files import read_image
from jaxcloseup.captures.world_frames import Frame, frame_intrinsics
from jaxcloseup.photos.scene import DuplicateFileWarning, SceneError


TEST_EVERY = 8
CLOSEST_SHARE = 0.1
WIDE = 16  # training photographs of `macro`, as many as MACRO (arXiv 2607.03875) has of a scene
_NEARER = 2  # how many times nearer its close-ups are, or more
_FAR = 0.9  # quantile of the world sizes of pixels; wide photographs have half of it, or more

_Member = TypeVar("_Member")  # a photograph, or its number

# Returns frames that list the points they show, and these points `[P, 3]`.
FindPoints = Callable[[Sequence[Frame]], tuple[list[Frame], np.ndarray]]


class Division(NamedTuple):
    """The photographs of a capture by split."""

    frames: dict[str, list[Frame]]  # photographs of each split present, `train` first
    notes: tuple[str, ...] = ()  # sentences on how they were split
    # for `closest` and `macro`, how many times nearer each `test` photograph is than the median
    # `train` one; for `zoom`, how many times finer each close-up is; otherwise None
    times_nearer: tuple[float, ...] | None = None


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
      points: `[P, 3]` world points, which `closest` and `macro` need.
      zoom: how many times finer the close-ups of `zoom` are.
      find_points: finds them for these where there are none.

    Raises:
      SceneError: `closest` or `macro` has too few photographs, no points that they see, or no
        photographs that are near enough.
    """
    if split in ("given", "listed") and given:
        return Division(given)
    frames = sorted({frame.file: frame for frame in frames}.values(), key=lambda f: f.listed)
    if split == "listed":
        note = f"{name} lists no splits: all of its {len(frames)} photographs train, none is scored"
        return Division({"train": frames}, (note,))
    if split in ("closest", "macro"):
        sizes, by = _sizes_of_pixels(name, split, frames, points, find_points)
        return (_closest if split == "closest" else _macro)(name, frames, sizes, by)
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


def _every_eighth(members: Sequence[_Member]) -> dict[str, list[_Member]]:
    if len(members) == 1:
        return {"train": list(members)}
    return {
        "train": [member for i, member in enumerate(members) if i % TEST_EVERY],
        "test_far": [member for i, member in enumerate(members) if i % TEST_EVERY == 0],
    }


def _sizes_of_pixels(
    name: str,
    split: str,
    frames: Sequence[Frame],
    points: np.ndarray,
    find_points: FindPoints | None,
) -> tuple[np.ndarray, str]:
    """Return what `_size_of_pixel` says of each photograph `[V]`, and by which points, in words."""
    if len(frames) < 2:
        raise SceneError(f"{name}: split {split} needs at least 2 photographs, got 1: add some.")
    showing, by = frames, ""
    if not len(points) and find_points:
        showing, points = find_points(frames)
        by = f" by {len(points)} points triangulated from their features"
    sizes = np.array([_size_of_pixel(frame, points) for frame in showing])
    if not np.isfinite(sizes).any():
        raise SceneError(
            f"{name}: split {split} needs points that the photographs see, but the capture lists "
            "none and the photographs' features give none: read its COLMAP model "
            "(--format=colmap), give ply_file_path, or choose --split=zoom, which needs no points."
        )
    return sizes, by


def _closest(name: str, frames: Sequence[Frame], sizes: np.ndarray, by: str) -> Division:
    nearest = np.argsort(sizes, kind="stable")[: max(1, round(CLOSEST_SHARE * len(frames)))]
    held_out = sorted(nearest.tolist())
    rest = [i for i in range(len(frames)) if i not in held_out]
    parts = _every_eighth(rest)
    train, far = parts["train"], parts.get("test_far", [])
    ratios = np.median(sizes[train]) / sizes[held_out]
    note = (
        f"{name}: test is the {len(held_out)} nearest of {len(frames)} photographs{by}, "
        f"{_nearer(ratios)} than the median of {len(train)} training photographs; test_far is "
        f"{len(far)} others"
    )
    return _divided(frames, train, held_out, far, note, ratios)


def _macro(name: str, frames: Sequence[Frame], sizes: np.ndarray, by: str) -> Division:
    # The far end says what is wide, because most photographs may be close-ups.
    least = np.quantile(sizes[np.isfinite(sizes)], _FAR) / _NEARER
    wide = [i for i, size in enumerate(sizes) if least < size < np.inf]
    poses = np.stack([frames[i].camtoworld for i in wide])
    train = [wide[k] for k in choose_photographs(name, poses, min(WIDE, len(wide)), "spread")]
    ratios = np.median(sizes[train]) / sizes
    others = [i for i in range(len(frames)) if i not in train]
    held_out = [i for i in others if ratios[i] >= _NEARER]
    if not held_out:
        raise SceneError(
            f"{name}: split macro needs photographs {_NEARER} times nearer than its "
            f"{len(train)} wide ones, and has none: choose --split=closest."
        )
    far = [i for i in others if i not in held_out][::TEST_EVERY]
    note = (
        f"{name}: train is {len(train)} wide photographs that are far apart; test is the "
        f"{len(held_out)} of {len(frames)}{by} that are {_nearer(ratios[held_out])} than the "
        f"median of these; test_far is {len(far)} others"
    )
    return _divided(frames, train, held_out, far, note, ratios[held_out])


def _nearer(ratios: np.ndarray) -> str:
    return f"{min(ratios):.2f} to {max(ratios):.2f} times nearer (median {np.median(ratios):.2f})"


def _divided(
    frames: Sequence[Frame],
    train: Sequence[int],
    test: Sequence[int],
    far: Sequence[int],
    note: str,
    ratios: np.ndarray,
) -> Division:
    rows = {"train": train, "test": test, "test_far": far}
    parts = {split: [frames[i] for i in chosen] for split, chosen in rows.items() if chosen}
    return Division(parts, (note,), tuple(map(float, ratios)))


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
