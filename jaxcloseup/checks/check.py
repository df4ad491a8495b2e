"""Check a capture's folder; what was found is kept until one of its files changes."""

import dataclasses
import logging
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from jaxcloseup.captures.contents import list_photographs
from jaxcloseup.captures.names import file_names
from jaxcloseup.captures.photo import Reading
from jaxcloseup.captures.photo_masks import understood_masks
from jaxcloseup.captures.world_frames import Frame
from jaxcloseup.checks.evidence import gather
from jaxcloseup.checks.judge import Checked, judge
from jaxcloseup.io.cache import Stored, cache_path, cached, content_hash, hash_files
from jaxcloseup.photos.scene import SceneError


_SOURCES = ("checks/*.py", "captures/*.py")  # any change may change what is found
_MOST = 120  # photographs that are checked; of more, so many evenly spread ones
_log = logging.getLogger(__name__)


def check_capture(
    path: str | pathlib.Path,
    *,
    format: str | None = None,
    reading: Reading | None = None,
    corrections: Sequence[str] = (),
    report: Callable[[int, int], object] = lambda done, total: None,
) -> Checked:
    """Check whether a capture's poses, lenses and points fit its photographs.

    Photographs are matched by their content alone, and the matches are held against the poses.
    Where they do not fit, known mistakes are tried.

    Args:
      path: folder of the capture.
      format: the only format to read; as `load_scene`.
      reading: how photographs and masks are read; its divisors do not count.
      corrections: corrections that are applied before; as `load_scene`.
      report: receives the numbers of photographs that are read, and of all.

    Returns:
      What was found, of at most 120 photographs, evenly spread.

    Raises:
      SceneError: the capture cannot be read, or its photographs are of other sizes than it says.
    """
    reading = (reading or Reading())._replace(downscale=1, zoom=1)
    listed = list_photographs(pathlib.Path(path), format=format, corrections=corrections)
    frames, names = listed.frames, file_names([frame.file for frame in listed.frames])
    if len(frames) > _MOST:
        rows = np.linspace(0, len(frames) - 1, _MOST).astype(int)
        frames, names = [frames[i] for i in rows], [names[i] for i in rows]
    masks, _ = understood_masks("", frames, inverted=reading.invert_masks)
    reading = reading._replace(masks=masks)

    def make() -> Checked:
        evidence = gather(frames, reading, lambda done: report(done, len(frames)), names)
        opengl, whole = listed.format == "transforms", len(frames) == len(listed.frames)
        found = judge(evidence, listed.points, opengl=opengl, ordered=whole)
        if evidence.turned and not any(text.startswith("turn=") for text in found.corrections):
            raise SceneError(evidence.turned)
        return found

    files = [file for frame in frames for file in (frame.file, frame.mask) if file]
    stats = [(str(file), (s := file.stat()).st_size, s.st_mtime_ns) for file in files]
    given = [(f.listed, f.camtoworld.tolist(), f.size, _lens(f), f.turns) for f in frames], names
    folder = pathlib.Path(__file__).parents[1]
    code = hash_files(file for pattern in _SOURCES for file in sorted(folder.glob(pattern)))
    points = content_hash(np.ascontiguousarray(listed.points))
    key = content_hash(repr([code, cv2.__version__, reading, stats, given, points]).encode())
    return cached(
        cache_path("checks", f"{key}.check"),
        key,
        make,
        pack=lambda found: Stored({}, dataclasses.asdict(found)),
        unpack=lambda stored: _unpack(stored.record),
        report=_log.warning,
        report_unwritable=_log.debug,
    )


def _lens(frame: Frame) -> list[dict[str, Any]]:
    """Return a frame's own fields and those of its whole file, without lists."""
    # Those of a file are of all its photographs, whose text would be repeated for each of them.
    return [
        {key: value for key, value in fields.items() if not isinstance(value, list)}
        for fields in frame.lens
    ]


def _unpack(record: dict[str, Any]) -> Checked:
    """Return what a JSON record holds; lists become tuples again."""
    lists = {name: tuple(value) for name, value in record.items() if isinstance(value, list)}
    lists["worst"] = tuple((name, share) for name, share in record["worst"])
    return Checked(**{**record, **lists})
