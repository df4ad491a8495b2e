"""Write everything that reports a run: results.json, pictures and the page, pictures first."""

import base64
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxcloseup.app.report.audits import (
    detail_table,
    gate_table,
    label_plots,
    labels_table,
    zoom_plots,
)
from jaxcloseup.app.report.headline import all_scores, best_stage, conclusion, run_tables
from jaxcloseup.app.report.page import QUALITIES, Picture, by_section, fill_page
from jaxcloseup.app.report.pictures import comparisons, fit_page, label_pictures
from jaxcloseup.app.report.showcase import Exhibit, exhibits
from jaxcloseup.app.run.gate import verdict
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.loop import Training
from jaxcloseup.app.run.photograph_sizes import finest_read
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.stages import Outcome
from jaxcloseup.app.run.timers import timed
from jaxcloseup.app.score.metrics_text import SPLIT_TITLES
from jaxcloseup.app.score.targets import Target
from jaxcloseup.artifacts.images import encode_webp_animation
from jaxcloseup.io.files import write_file, write_json
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.pyramids import Pyramid


_FPS = 12
_DOLLY_WIDTH = 480  # in pixels, on the page
_MOST_BYTES = 4_000_000  # of the page


def report_run(
    output_dir: pathlib.Path,
    training: Training,
    outcome: Outcome,
    about: Mapping[str, Any],
    *,
    dolly: Sequence[np.ndarray] = (),
) -> dict[str, Any]:
    """Write `results.json`, `dolly.webp`, `compare/`, `labels/` and `report.html`.

    Args:
      output_dir: folder of the run.
      training: the training, with the seconds and the history of its stages.
      outcome: what the stages produced.
      about: "method", "preset", "seed", "config" and "versions".
      dolly: frames, uint8 `[H, W, 3]`, of a camera that comes near.

    Returns:
      What `results.json` holds.
    """
    programs, scene = training.programs, training.programs.scene
    with timed(training.seconds, "report"):
        targets = outcome.held_out.targets
        brief = list(dict.fromkeys(["baseline", best_stage(outcome.scores)]))
        pictures = comparisons(output_dir / "compare", targets, outcome.images, in_report=brief)
        pictures += label_pictures(
            run_keys(about["seed"]).pictures,
            outcome.held_out.reduced("test"),
            output_dir / "labels",
            scene=scene,
            sources=outcome.start.sources,
            settings=outcome.settings,
            render_depth=lambda camera: label_depth(programs.render(outcome.start.state, camera)),
        )
    size = scene.train.cameras
    results = {
        "scene": scene.name,
        **about,
        "resolution": [size.width, size.height],
        "scored_at": _size(targets),
        "check": scene.metadata.get("check"),
        "stages": outcome.scores,
        **outcome.evidence,
        "seconds": training.seconds,
        "history": training.history,
    }
    write_json(output_dir / "results.json", results)
    moving = b""
    if dolly:
        moving = encode_webp_animation(_there_and_back(dolly), fps=_FPS)
        write_file(output_dir / "dolly.webp", moving)
        small = [fit_page(frame, _DOLLY_WIDTH) for frame in dolly]
        moving = encode_webp_animation(_there_and_back(small), fps=_FPS, quality=70)
    shown = _showcase(programs, outcome)
    write_report(output_dir / "report.html", results, shown, pictures, dolly=moving)
    return results


def _there_and_back(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [*frames, *frames[-2:0:-1]]


def _showcase(programs: Programs, outcome: Outcome) -> list[Exhibit]:
    """Return the close-ups at the top of the page, as the best stage renders them."""
    targets, stage = outcome.held_out.targets, best_stage(outcome.scores)
    if not targets.get("test"):
        return []
    views = outcome.scores[stage]["test"]["views"]
    return exhibits(
        targets["test"],
        outcome.images[stage, "test"],
        {name: view["psnr"] for name, view in views.items() if view["psnr"] is not None},
        render_depth=lambda camera: label_depth(programs.render(outcome.start.state, camera)),
        sources=outcome.start.sources,
        photographs=_loaded_photographs(programs, outcome),
        names=programs.scene.names["train"],
    )


def _loaded_photographs(programs: Programs, outcome: Outcome) -> Pyramid:
    """Return the finest photographs that stages have read; a report reads and draws no others."""
    finest = (
        finest_read(programs.preset, programs.scene) if outcome.evidence["detail"] is None else 1
    )
    return programs.pyramid(finest)[0]


def _size(targets: Mapping[str, Sequence[Target]]) -> list[int] | None:
    """Return width and height of the views that are scored first, or None without any."""
    for views in targets.values():
        if views:
            return [views[0].camera.width, views[0].camera.height]
    return None


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
    data = dict(
        title=results["scene"],
        verdict=conclusion(results),
        results=results,
        size=" x ".join(map(str, results["scored_at"] or results["resolution"])),
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
        detail_table=detail_table(detail) if detail and detail["errors"] else None,
        config=json.dumps({key: results[key] for key in ("config", "versions")}, indent=1),
    )
    for quality in QUALITIES:
        page = fill_page("run.html", quality=quality, **data)
        if len(page) <= _MOST_BYTES:
            break
    write_file(path, page)
