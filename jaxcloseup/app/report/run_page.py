"""The report of a run: tables for the terminal, and one self-contained page, pictures first."""

import base64
import html
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from jaxcloseup.app.report.audits import (
    detail_table,
    gate_table,
    label_plots,
    labels_table,
    zoom_plots,
)
from jaxcloseup.app.report.headline import best_stage, conclusion, tables
from jaxcloseup.app.report.page import (
    Picture,
    figure,
    figures,
    folded,
    head,
    score_tables,
    slider,
    table,
)
from jaxcloseup.app.report.showcase import Exhibit
from jaxcloseup.app.score.metrics_text import COLUMNS, SPLIT_TITLES, format_metric
from jaxcloseup.io.files import write_file


_STAGES = (
    "<p class=quiet><i>closeup</i> learns pseudo-labels of random close-ups, and <i>test_time</i> "
    "those of the very close-ups that are scored. <i>control</i> and <i>test_time_control</i> take "
    "as many steps without, so compare with these. <i>detail</i> adds to the renders of a stage, "
    "without training, what the photographs show beyond it. Higher PSNR and SSIM are better, and "
    "lower LPIPS.</p>"
)


def rows(results: Mapping[str, Any]) -> list[list[str]]:
    """Return all scores of a run as text: a header, then a row for each split and stage."""
    shown = [
        key
        for key in COLUMNS
        if any(
            split.get(key) is not None for s in results["stages"].values() for split in s.values()
        )
    ]
    found = [["views", "stage", *(COLUMNS[key] for key in shown)]]
    for split, title in SPLIT_TITLES.items():
        for stage, splits in results["stages"].items():
            if split in splits:
                values = [splits[split].get(key) for key in shown]
                found.append([title, stage, *map(format_metric, shown, values)])
    return found


def print_results(results: Mapping[str, Any]) -> None:
    """Print what the run found, and a table of each kind of view."""
    print_tables(tables(results), conclusion(results))


def print_tables(
    found: Mapping[str, tuple[Sequence[str], Sequence[Sequence[str]]]], sentence: str
) -> None:
    """Print tables, each a header and rows, under their titles, and a sentence."""
    console = Console()
    for title, (header, body) in found.items():
        shown = Table(title=title, title_justify="left")
        for i, name in enumerate(header):
            # Stages are never cut, however narrow the terminal is.
            shown.add_column(name, no_wrap=not i, justify="right" if i else "left")
        for row in body:
            shown.add_row(*row)
        console.print(shown)
    console.print(sentence, highlight=False)


def write_report(
    path: pathlib.Path,
    results: Mapping[str, Any],
    shown: Sequence[Exhibit],
    pictures: Sequence[Picture],
    *,
    dolly: bytes = b"",
) -> None:
    """Write the page, which needs no other file.

    Args:
      path: file to write.
      results: what `results.json` holds.
      shown: close-ups to begin with.
      pictures: further pictures, grouped by section.
      dolly: a WebP of a camera that comes near; empty: none.
    """
    size, finer = (results[key] for key in ("resolution", "finer_resolution"))
    sizes = f"{size[0]} x {size[1]} pixels" + (f" and {finer[0]} x {finer[1]}" if finer else "")
    parts = [
        *head(results["scene"]),
        f"<p class=verdict>{html.escape(conclusion(results))}</p>",
        f"<p class=quiet>{html.escape(results['method'])}, preset "
        f"{html.escape(results['preset'])}, seed {results['seed']}; held-out views are scored at "
        f"{sizes}, on 8-bit images.</p>",
        *_exhibition(shown, best_stage(results["stages"])),
        *_moving(dolly),
    ]
    views = [picture for picture in pictures if picture.section in SPLIT_TITLES.values()]
    labels = [picture for picture in pictures if picture not in views]
    parts += figures(views)
    parts += ["<h2>Scores</h2>", *score_tables(tables(results)), _STAGES]
    parts += folded("PSNR by magnification", zoom_plots(results["stages"]))
    header, *body = rows(results)
    parts += folded("All scores", [table(header, body, names=2)])
    audits = [labels_table(results["labels"])] if results["labels"] else []
    audits += label_plots(results["labels"], results["left_out"])
    audits += [gate_table(results["gate"])] if results["gate"] else []
    parts += folded("How right are the labels?", audits + figures(labels))
    if results["detail"]:
        parts += folded("How right is the detail?", [detail_table(results["detail"])])
    config = html.escape(json.dumps({k: results[k] for k in ("config", "versions")}, indent=1))
    parts += [*folded("Configuration", [f"<pre class=wide>{config}</pre>"]), "</html>"]
    write_file(path, "\n".join(parts).encode())


def _moving(dolly):
    if not dolly:
        return []
    text = "from where a photograph was taken towards what a close-up shows, and back"
    source = f"data:image/webp;base64,{base64.b64encode(dolly).decode()}"
    image = f"<img alt='{text}' src='{source}'>"
    return [f"<figure class=moving>{image}<figcaption>{text}</figcaption></figure>"]


def _say_of_pixels(size):
    """Say how large a photograph's pixels are in a close-up."""
    if size < 1:
        return f"whose pixels are {1 / size:.1f} times finer"
    return f"whose pixels are {size:.1f} times as large"


def _exhibition(shown, stage):
    """Close-ups, each with a slider between its render and a photograph of the same place."""
    if not shown:
        return []
    parts = [
        "<h2>Close-ups beside photographs</h2><p class=quiet>The held-out close-ups with the "
        "highest, the middle and the lowest PSNR. Move across a picture: on its left is what the "
        "photograph that shows most of this place has, cut out, and on its right what this run "
        "renders.</p>"
    ]
    for one in shown:
        psnr = f"{one.name}: {stage}, {one.psnr:.1f} dB"
        truth = figure(one.truth, "the truth")
        if one.cutout is None:
            parts += ["<div class=pair>", figure(one.render, psnr), truth, "</div>"]
            continue
        caption = f"left: {one.photograph}, {_say_of_pixels(one.pixel)}; right: {psnr}"
        pair = slider(one.cutout, one.render, (one.photograph, psnr), caption)
        parts.append(f"<div class=pair>{pair}{truth}</div>")
    return parts
