"""Write everything that reports a run: results.json, pictures and the page."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxcloseup.app.report.headline import best_stage
from jaxcloseup.app.report.pictures import comparisons, label_pictures
from jaxcloseup.app.report.run_page import write_report
from jaxcloseup.app.report.showcase import Exhibit, exhibits
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.setup import Training, timed
from jaxcloseup.app.run.stages import Outcome
from jaxcloseup.app.score.metrics_text import FINER
from jaxcloseup.app.score.targets import Target
from jaxcloseup.artifacts.images import encode_webp_animation
from jaxcloseup.io.files import write_file, write_json
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.pyramids import Pyramid


_FPS = 12


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
        _, _, key = jax.random.split(jax.random.key(about["seed"]), 3)
        pictures += label_pictures(
            key,
            targets.get("test", []),
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
        "finer_resolution": _finer_resolution(targets),
        "stages": outcome.scores,
        "labels": outcome.audit,
        "left_out": outcome.left_out,
        "gate": outcome.gate,
        "detail": outcome.detail,
        "seconds": training.seconds,
        "history": training.history,
    }
    write_json(output_dir / "results.json", results)
    moving = b""
    if dolly:
        moving = encode_webp_animation([*dolly, *dolly[-2:0:-1]], fps=_FPS)  # there and back
        write_file(output_dir / "dolly.webp", moving)
    shown = _showcase(programs, outcome)
    write_report(output_dir / "report.html", results, shown, pictures, dolly=moving)
    return results


def _showcase(programs: Programs, outcome: Outcome) -> list[Exhibit]:
    """The close-ups that the page begins with, as the best stage renders them."""
    targets, stage = outcome.held_out.targets, best_stage(outcome.scores)
    split = next((name for name in (f"test{FINER}", "test") if targets.get(name)), None)
    if split is None:
        return []
    views = outcome.scores[stage][split]["views"]
    return exhibits(
        targets[split],
        outcome.images[stage, split],
        {name: one["psnr"] for name, one in views.items() if one["psnr"] is not None},
        render_depth=lambda camera: label_depth(programs.render(outcome.start.state, camera)),
        sources=outcome.start.sources,
        photographs=_loaded_photographs(programs, outcome),
        names=programs.scene.names["train"],
    )


def _loaded_photographs(programs: Programs, outcome: Outcome) -> Pyramid:
    """The finest photographs that the stages have read: a report must not draw or read others."""
    windows, finest = programs.preset.windows, programs.preset.downscale
    if outcome.detail is not None:
        finest = 1
    elif windows is not None:
        finest = windows.finest
    return programs.pyramid(finest)[0]


def _finer_resolution(targets: Mapping[str, Sequence[Target]]) -> list[int] | None:
    """Width and height of the views that are scored at a finer size, or None."""
    for split, views in targets.items():
        if split.endswith(FINER) and views:
            return [views[0].camera.width, views[0].camera.height]
    return None
