"""Check captures before they are trained on: print what was found, and refuse those that misfit."""

import dataclasses
import shlex
from collections.abc import Mapping
from typing import Any

from jaxcloseup.app import progress
from jaxcloseup.captures.load import is_drawn
from jaxcloseup.captures.photo import Reading
from jaxcloseup.checks.check import check_capture
from jaxcloseup.checks.judge import MISFIT, Checked
from jaxcloseup.photos.scene import SceneError


# Options of `load_scene` that photographs are checked with.
_READING = ("half_pixel", "invert_masks", "alpha_mode")


def check_scene(name: str, options: Mapping[str, Any]) -> Checked | None:
    """Check a capture, and show progress; return None for a built-in scene.

    Args:
      name: scene or folder, as of `load_scene`.
      options: options of `load_scene`.

    Raises:
      SceneError: the capture cannot be read.
    """
    if is_drawn(name):
        return None
    reading = Reading(**{key: options[key] for key in _READING if key in options})
    with progress.saying("checking photographs") as say:
        return check_capture(
            name,
            format=options.get("format"),
            reading=reading,
            corrections=options.get("corrections", ()),
            report=lambda done, total: say(f"checking photographs: {done} of {total}"),
        )


def fitting_options(
    name: str, options: Mapping[str, Any], *, fix: bool, allow_misfit: bool
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Check a capture before training; print what was found.

    Points that do not lie on surfaces are replaced by triangulated ones. Poses and lenses change
    only with `fix`.

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
    found = check_scene(name, options)
    if found is None:
        return dict(options), None
    applied = list(options.get("corrections", ()))
    if found.verdict == MISFIT and found.corrections and fix:
        applied += found.corrections
        print(f"{name}: {found.sentence}; corrected by {', '.join(found.corrections)}")
    elif found.verdict == MISFIT and not allow_misfit:
        raise SceneError(f"{name}: {found.sentence}: {advice(found)}.")
    else:
        print(f"{name}: {found.sentence}")
    turned = found.points and found.points != ("points=none",)
    if found.points:
        # Without the user's word a turn is not applied, but wrong points are not used either.
        applied += found.points if fix else ("points=none",)
        instead = f"turned by {found.points[0]}" if fix and turned else "not used"
        print(
            f"{name}: points are {instead}" + ("; --fix turns them" if turned and not fix else "")
        )
    for note in found.notes:
        print(f"{name}: {note}")
    changed = {**options, "corrections": applied} if applied else dict(options)
    return changed, dataclasses.asdict(found)


def advice(found: Checked) -> str:
    """Return what to do about poses that do not fit."""
    if not found.corrections:
        return "correct the poses, or give --allow_misfit to train all the same"
    return (
        "correct the file, or give --fix, which applies "
        f"{shlex.quote(' '.join(found.corrections)):.60} to what is read"
    )
