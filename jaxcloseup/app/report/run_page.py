"""The page of a run, pictures first; what most readers skip is folded away."""

import base64
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from jaxcloseup.app.report.audits import (
    detail_table,
    gate_table,
    label_plots,
    labels_table,
    zoom_plots,
)
from jaxcloseup.app.report.headline import all_scores, best_stage, conclusion, run_tables
from jaxcloseup.app.report.page import Picture, by_section, fill_page
from jaxcloseup.app.report.showcase import Exhibit
from jaxcloseup.app.run.gate import verdict
from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.io.files import write_file


def write_report(
    path: pathlib.Path,
    results: Mapping[str, Any],
    exhibits: Sequence[Exhibit],
    pictures: Sequence[Picture],
    *,
    dolly: bytes = b"",
) -> None:
    """Write the page of a run.

    Args:
      path: file to write.
      results: content of `results.json`.
      exhibits: close-ups at the top of the page.
      pictures: further pictures, grouped by section.
      dolly: a WebP of a camera that comes near; empty without one.
    """
    labels, gate, detail = results["labels"], results["gate"], results["detail"]
    sections = by_section(pictures)
    views = {title: shown for title, shown in sections.items() if title in SPLIT_TITLES.values()}
    sizes = [results["resolution"], results["finer_resolution"]]
    (width, height), *finer = [size for size in sizes if size]
    page = fill_page(
        "run.html",
        title=results["scene"],
        verdict=conclusion(results),
        results=results,
        sizes=" and ".join([f"{width} x {height} pixels", *(f"{w} x {h}" for w, h in finer)]),
        exhibits=exhibits,
        stage=best_stage(results["stages"]),
        dolly=dolly and f"data:image/webp;base64,{base64.b64encode(dolly).decode()}",
        views=views,
        tables=run_tables(results),
        zoom_plots=zoom_plots(results["stages"]),
        all_scores=all_scores(results["stages"]),
        labels_table=labels_table(labels) if labels else None,
        label_plots=label_plots(labels, results["left_out"]),
        gate_table=gate_table(gate) if gate else None,
        gate_verdict=verdict(gate) if gate else None,
        labels={title: shown for title, shown in sections.items() if title not in views},
        detail_table=detail_table(detail) if detail else None,
        config=json.dumps({key: results[key] for key in ("config", "versions")}, indent=1),
    )
    write_file(path, page)
