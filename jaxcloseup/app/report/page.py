"""What pages share: their style, and pictures under headings."""

import html
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.artifacts.images import webp_data_uri


class Picture(NamedTuple):
    """A picture on the page.

    Attributes:
      section: heading that groups pictures.
      caption: text below the picture.
      image: uint8 `[H, W, 3]`.
    """

    section: str
    caption: str
    image: np.ndarray


_READABLE = 0.7  # of the width of a row of panels, whose titles are smaller otherwise
_SMALL = 70  # quality of pictures that are many
_COMPARISON_NOTE = (
    "Each picture shows the true image, renders in the order trained, and the error of the last "
    "one: black is none, and bright yellow is a quarter of the range of colors, or more. Detail "
    "gives what no photograph shows the colors around it."
)
_PICTURE_NOTES = {
    **dict.fromkeys(SPLIT_TITLES.values(), _COMPARISON_NOTE),
    "Pseudo-labels": "Each picture shows how one label is made: colors warped backward from the "
    "source photograph that the caption names, colors warped forward from all photographs, the "
    "pixels where both agree (kept), the same as a mask (white), the rendered depth, and the true "
    "image where it is known. Good labels cover much of the image and look like the true image.",
}


def figures(pictures: Sequence[Picture]) -> list[str]:
    """Return the lines of a page with the pictures, under a heading for each section."""
    parts, section = [], None
    for picture in pictures:
        if picture.section != section:
            section = picture.section
            parts.append(f"<h2>{html.escape(section)}</h2>")
            note = _PICTURE_NOTES.get(section.split(": ")[-1])  # a sweep's begin with the scene
            parts += [f"<p>{note}</p>"] if note else []
        parts.append(figure(picture.image, picture.caption, quality=_SMALL, row=True))
    return parts


def figure(image: np.ndarray, caption: str, *, quality: int = 90, row: bool = False) -> str:
    """Return an image with its caption.

    Args:
      image: uint8 `[H, W, 3]`.
      caption: text below it.
      quality: that of `webp_data_uri`.
      row: whether it is a row of panels with titles: on a phone it then goes on sideways, so that
        these can be read.
    """
    caption = html.escape(caption)
    least = f" style='min-width: {_READABLE * image.shape[1]:.0f}px'" if row else ""
    image = f"<img alt='{caption}' src='{webp_data_uri(image, quality=quality)}'{least}>"
    image = f"<div class=wide>{image}</div>" if row else image
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def slider(
    left: np.ndarray,
    right: np.ndarray,
    names: tuple[str, str],
    caption: str,
    *,
    quality: int = 90,
) -> str:
    """Return two images of one size, one over the other, and a slider that uncovers the left one.

    It lies in an element of class `pair`, whose sliders all move together.

    Args:
      left: uint8 `[H, W, 3]`.
      right: uint8 `[H, W, 3]`.
      names: what the images are.
      caption: text below them.
      quality: that of `webp_data_uri`.
    """
    over, under = (webp_data_uri(image, quality=quality) for image in (left, right))
    left_name, right_name = map(html.escape, names)
    return (
        "<figure class=slider><div>"
        f"<img alt='{right_name}' src='{under}'><img alt='{left_name}' src='{over}'>"
        f"<input type=range min=0 max=100 value=50 aria-label='from {left_name} to {right_name}' "
        "oninput=\"this.closest('.pair').style.setProperty('--at', this.value + '%')\"></div>"
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def score_tables(found: Mapping[str, tuple[Sequence[str], Sequence[Sequence[str]]]]) -> list[str]:
    """Return tables side by side, each a header and rows, under their titles."""
    parts = [
        f"<div><h3>{html.escape(title)}</h3>{table(header, body)}</div>"
        for title, (header, body) in found.items()
    ]
    return ["<div class=tables>", *parts, "</div>"]


def table(header: Sequence[str], body: Sequence[Sequence[str]], *, names: int = 1) -> str:
    """Return a table of text.

    Args:
      header: its first row.
      body: the other rows.
      names: number of columns, 1 or 2, that hold no numbers.
    """
    lines = ["".join(f"<th>{html.escape(cell)}" for cell in header)]
    lines += ["".join(f"<td>{html.escape(cell)}" for cell in row) for row in body]
    return f"<div class=wide><table class=names{names}><tr>" + "<tr>".join(lines) + "</table></div>"


def folded(summary: str, parts: Sequence[str]) -> list[str]:
    """Return parts of a page that a click unfolds; nothing for no parts."""
    return [f"<details><summary>{summary}</summary>", *parts, "</details>"] if parts else []


def head(title: str) -> list[str]:
    """Return the beginning of a page, with its heading."""
    return [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width, initial-scale=1'>",
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>",
        f"<h1>{html.escape(title)}</h1>",
    ]


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1200px; margin: 2em auto; padding: 0 1em }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { padding: .25em .8em; text-align: right; border-bottom: 1px solid #ccc }
th:first-child, td:first-child, .names2 :nth-child(2) { text-align: left; white-space: nowrap }
.wide { overflow-x: auto }
.verdict { font-size: 1.25em }
.quiet, figcaption { color: #555 }
figcaption, h1, p { overflow-wrap: anywhere }
figure { margin: 1em 0 }
.plots, .tables { display: flex; flex-wrap: wrap; gap: 1em 3em }
.tables > div { min-width: 0 }
.plots svg { max-width: 100%; height: auto }
img { display: block; width: 100% }
details { margin: 1em 0; border-top: 1px solid #ccc; padding-top: 1em }
summary { cursor: pointer; font-size: 1.25em; font-weight: bold }
.moving { max-width: 590px }
.pair { --at: 50%; display: grid; gap: 0 1em;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 340px), 1fr)) }
.slider div { position: relative }
.slider img + img { position: absolute; inset: 0; clip-path: inset(0 calc(100% - var(--at)) 0 0) }
.slider input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0;
  cursor: ew-resize }
.slider div::after { content: ""; position: absolute; top: 0; bottom: 0; left: var(--at);
  width: 2px; margin-left: -1px; background: white; box-shadow: 0 0 3px black;
  pointer-events: none }
"""
