"""The page of a check: its sentences, the cameras from above, and the worst photographs."""

import pathlib
from collections.abc import Sequence

import cv2
import imageio.v3 as imageio
import numpy as np

from jaxcloseup.app.process.from_above import draw_cameras
from jaxcloseup.app.report.page import fill_page
from jaxcloseup.app.report.record_table import Table
from jaxcloseup.app.run.capture_check import said_of
from jaxcloseup.captures.contents import Listed
from jaxcloseup.captures.names import file_names
from jaxcloseup.captures.photo import Reading
from jaxcloseup.captures.small_photos import read_small
from jaxcloseup.checks.judge import Checked
from jaxcloseup.io.files import write_file


NAME = "check.html"
_SIDE, _COLUMNS = 320, 4  # pixels of a photograph on the contact sheet, and photographs in a row
_FIGURES = {
    "photographs": ("photographs", ","),
    "without_matches": ("photographs that share no features with others", ","),
    "neighbor_degrees": ("degrees between similar photographs, median", ".1f"),
    "parallax": ("degrees by which features move between the farthest cameras, median", ".0f"),
    "views": ("photographs that have a point in view, median", ".0f"),
    "degrees": ("widest angle between them in degrees, median", ".0f"),
    "nearest": ("distance of the nearest, as a share of the usual one", ".2f"),
    "matches": ("features that match between photographs", ","),
    "share": ("of these within 2 pixels of the poses", ".1%"),
    "median": ("their median error in pixels", ".2f"),
    "points": ("points", ","),
    "points_share": ("points that look alike in two photographs", ".1%"),
    "points_moved": ("the same, if they are moved off their place", ".1%"),
}
_ALL_FIT = 0.9  # share of a photograph's matches from which it is not shown


def write_check(
    folder: pathlib.Path, name: str, found: Checked, listed: Listed, reading: Reading
) -> pathlib.Path:
    """Write `check.html` of a capture, and return its path.

    Args:
      folder: folder to write into; made if it does not exist.
      name: name of the capture.
      found: what the check found.
      listed: the capture's photographs and points.
      reading: how photographs are read.

    Raises:
      OSError: the page cannot be written.
    """
    poses = np.stack([frame.camtoworld for frame in listed.frames])
    above = draw_cameras(poses, listed.points, listed.rgb)
    worst = [(photo, share) for photo, share in found.worst if share < _ALL_FIT]
    names = file_names([frame.file for frame in listed.frames])
    by_name = dict(zip(names, listed.frames, strict=True))
    pictures = [read_small(by_name[photo], reading, _SIDE).rgb for photo, _ in worst]
    figures = [
        (text, f"{found.figures[key]:{form}}")
        for key, (text, form) in _FIGURES.items()
        if key in found.figures
    ]
    page = fill_page(
        "check.html",
        title=f"Check of {name}",
        said=[*said_of(found), *listed.notes],
        figures=Table("What was measured", ["", ""], figures),
        above=imageio.imread(above)[..., :3],
        sheet=_contact_sheet(pictures) if pictures else None,
        worst=[f"{photo}: {100 * share:.0f} %" for photo, share in worst],
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / NAME, page)
    return folder / NAME


def _contact_sheet(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Put photographs into rows, each in a square of `_SIDE` pixels."""
    rows = -(-len(pictures) // _COLUMNS)
    sheet = np.full((rows * _SIDE, _COLUMNS * _SIDE, 3), 255, np.uint8)
    for i, picture in enumerate(pictures):
        scale = _SIDE / max(picture.shape[:2])
        size = [max(1, round(scale * side)) for side in picture.shape[1::-1]]
        y, x = (_SIDE * at for at in divmod(i, _COLUMNS))
        sheet[y : y + size[1], x : x + size[0]] = cv2.resize(picture, size)
    return sheet
