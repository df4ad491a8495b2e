"""Say what lies in a capture's folder and is not used."""

import collections
import os
import pathlib
import re
from collections.abc import Sequence

from jaxcloseup.captures.photo_masks import FOLDER, is_picture
from jaxcloseup.captures.world_frames import Frame


# Reduced photographs, other formats, and what `process` writes.
_KNOWN = re.compile(r"images_\d+|sparse|colmap|cameras\.png|\..*")
_SHOWN = 3  # names of folders


def unused_note(capture: pathlib.Path, frames: Sequence[Frame]) -> tuple[str, ...]:
    """Count images beside the used files, and name folders without any; empty if there are none.

    Args:
      capture: folder of the capture; only it and folders of used files in it are listed.
      frames: all photographs, with their masks.
    """
    top = os.path.abspath(capture)
    used = [*(frame.file for frame in frames), *(frame.mask for frame in frames if frame.mask)]
    files = set(map(os.path.abspath, used))
    within = {file for file in files if file.startswith(os.path.join(top, ""))}
    ways = {str(parent) for file in within for parent in pathlib.PurePath(file).parents}
    counts: collections.Counter[str] = collections.Counter()
    folders = []
    for folder in sorted({top, *map(os.path.dirname, within)}):
        for entry in os.scandir(folder):
            if _KNOWN.fullmatch(entry.name) or entry.path in files or entry.path in ways:
                continue
            if entry.is_dir():
                folders.append(f"{os.path.relpath(entry.path, top)}/")
            elif is_picture(pathlib.Path(entry.path)):
                counts[os.path.relpath(folder, top)] += 1
    parts = []
    for folder, count in counts.items():
        kind = "masks" if FOLDER in pathlib.PurePath(folder).parts else "images"
        where = "its own folder" if folder == "." else f"{folder}/"
        parts.append(f"{count} {kind} in {where}")
    if folders:
        names = sorted(folders)
        more = f" and {len(names) - _SHOWN} others" if len(names) > _SHOWN else ""
        several = "s" if len(names) > 1 else ""
        parts.append(f"the subfolder{several} {', '.join(names[:_SHOWN])}{more}")
    return (f"{capture.resolve().name}: not used: {', '.join(parts)}",) if parts else ()
