"""Check captures before they are trained on: say what was found, and refuse those that misfit."""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

from jaxcloseup.app import progress
from jaxcloseup.captures.load import check_exists, is_drawn
from jaxcloseup.captures.photo import Reading
from jaxcloseup.checks.check import check_capture
from jaxcloseup.checks.judge import MISFIT, Checked
from jaxcloseup.photos.scene import SceneError


# Options of `load_scene` that photographs are checked with.
_READING = ("half_pixel", "invert_masks", "alpha_mode")
_SHOWN = 60  # characters of corrections in a sentence


def check_scene(name: str, options: Mapping[str, Any]) -> Checked:
    """Check a capture, and show progress.

    Args:
      name: folder of the capture.
      options: options of `load_scene`.

    Raises:
      SceneError: the capture cannot be read.
    """
    with progress.saying("checking photographs") as say:
        return check_capture(
            name,
            format=options.get("format"),
            reading=reading_of(options),
            corrections=options.get("corrections", ()),
            report=lambda done, total: say(f"checking photographs: {done} of {total}"),
        )


def reading_of(options: Mapping[str, Any]) -> Reading:
    """Return how photographs are read, from options of `load_scene`."""
    return Reading(**{key: options[key] for key in _READING if key in options})


def fitting_options(
    name: str, options: Mapping[str, Any], *, fix: bool, allow_misfit: bool
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Check a capture before training, and print what was found.

    Points that do not lie on surfaces are left out, so that triangulated ones are used. Poses,
    lenses and the world of points change only with `fix`.

    Args:
      name: scene or folder, as of `load_scene`.
      options: options of `load_scene`.
      fix: whether to correct a known mistake.
      allow_misfit: whether to train although poses do not fit.

    Returns:
      The options with corrections, and the record of what was found, or None for a built-in scene.

    Raises:
      SceneError: the capture cannot be read, or its poses do not fit.
    """
    if is_drawn(name):
        return dict(options), None
    check_exists(pathlib.Path(name))
    found = check_scene(name, options)
    first, *others = said_of(found)
    if found.verdict == MISFIT and not allow_misfit and not (fix and found.corrections):
        raise SceneError(f"{name}: {first}, or give --allow_misfit to train all the same.")
    for line in (first, *others):
        print(f"{name}: {line}")
    applied = [*options.get("corrections", ()), *(found.corrections if fix else ())]
    if found.points:
        applied += found.points if fix else ["points=none"]
    changed = {**options, "corrections": applied} if applied else dict(options)
    return changed, dataclasses.asdict(found)


def said_of(found: Checked) -> list[str]:
    """Return the sentences of a check: the result with what to do about it, then notes."""
    lines = [found.sentence]
    if found.verdict == MISFIT:
        text = " ".join(found.corrections)
        short = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
        lines[0] += f": correct the file, or give --fix to read it with {short}" * bool(text)
        lines[0] += ": correct the poses or lenses" * (not text)
    if found.points == ("points=none",):
        lines.append("its points are not used, but points that are triangulated from photographs")
    elif found.points:
        lines.append(
            f"give --fix to read points with {found.points[0]}; without it, points are "
            "triangulated from photographs"
        )
    return [*lines, *found.notes]
