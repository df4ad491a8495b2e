"""Pages: HTML templates, filled with plain data; each page is one file that needs no other."""

import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import jinja2
import numpy as np

from jaxcloseup.artifacts.images import webp_data_uri


_TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(pathlib.Path(__file__).parent / "templates"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters["webp"] = lambda image, quality: webp_data_uri(image, quality=quality)


QUALITIES = (90, 75, 50, 25)  # of pictures; the first that makes a page small enough is taken


class Picture(NamedTuple):
    """A picture on a page."""

    section: str  # heading that groups pictures
    caption: str  # text below the picture
    image: np.ndarray  # uint8 `[H, W, 3]`, a row of panels
    file: str = ""  # the same at its full size, from the page's folder; empty if there is none


def fill_page(template: str, *, title: str, **data: Any) -> bytes:
    """Return a page as bytes.

    Args:
      template: name of a file in `templates`.
      title: title and heading of the page.
      **data: what the template shows; texts are escaped.
    """
    return _TEMPLATES.get_template(template).render(title=title, **data).encode()


def by_section(pictures: Sequence[Picture]) -> dict[str, list[Picture]]:
    """Return pictures by their section, in order."""
    sections: dict[str, list[Picture]] = {}
    for picture in pictures:
        sections.setdefault(picture.section, []).append(picture)
    return sections
