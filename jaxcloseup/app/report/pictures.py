"""The pictures of a run: comparisons of its stages with the true images, and pseudo-labels."""

import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxcloseup.app.report.page import Picture
from jaxcloseup.app.score.metrics_text import FINER, SPLIT_TITLES
from jaxcloseup.app.score.scores import Target
from jaxcloseup.artifacts.images import colorize_depth, colorize_error, side_by_side, write_png
from jaxcloseup.captures.load import Scene
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.labels.make import (
    LabelSources,
    PseudoSettings,
    best_source,
    label_pixels,
    sample_virtual_camera,
)


SHOWN_LABELS = 6  # pictures of labels for each kind of camera


def comparisons(
    folder: pathlib.Path,
    targets: Mapping[str, Sequence[Target]],
    images: Mapping[tuple[str, str], Mapping[str, np.ndarray]],
    *,
    in_report: Sequence[str] | None = None,
) -> list[Picture]:
    """Write `<name>.png`: the true image, every stage, and the error of the last stage.

    A name that an earlier split has used gets its split as a prefix. A split that no stage rendered
    has no pictures, for example if every arm of a sweep failed.

    Args:
      folder: folder to write to.
      targets: held-out views by split.
      images: rendered colors by (stage, split), then by the view's name.
      in_report: stages that the report shows; default: all.

    Returns:
      The pictures, for the report.
    """
    pictures, written = [], set()
    # Finer views show the same, larger.
    shown = {split: views for split, views in targets.items() if split + FINER not in targets}
    for split, views in shown.items():
        stages = [stage for stage, rendered in images if rendered == split]
        for target in views if stages else ():
            seen = {stage: images[stage, split][target.name] for stage in stages}
            name = f"{split}_{target.name}" if target.name in written else target.name
            written.add(name)
            truth = np.asarray(target.rgb)
            write_png(folder / f"{name}.png", _comparison(truth, seen))
            brief = {stage: seen[stage] for stage in stages if stage in (in_report or stages)}
            section = SPLIT_TITLES[split.removesuffix(FINER)]
            pictures.append(Picture(section, target.name, _comparison(truth, brief)))
    return pictures


def _comparison(truth, seen):
    """The true image, `seen` stage by stage, and the error of the last one."""
    last = list(seen)[-1]
    error = colorize_error(np.abs(seen[last] - truth).mean(axis=-1))
    return _row({"truth": truth, **seen, f"error of {last}": error})


def _row(panels):
    return side_by_side(map(enlarge, panels.values()), labels=list(panels))


def enlarge(image: np.ndarray | jax.Array) -> np.ndarray:
    """Repeat the pixels of an image `[H, W, ...]` until it is at least 240 wide."""
    image = np.asarray(image)
    factor = -(-240 // image.shape[1])
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def label_pictures(
    key: jax.Array,
    targets: Sequence[Target],
    folder: pathlib.Path,
    *,
    scene: Scene,
    sources: LabelSources,
    settings: PseudoSettings,
    render_depth: Callable[[Camera], jax.Array],
) -> list[Picture]:
    """Write pictures of labels of random virtual cameras and of held-out close-ups.

    Args:
      key: random key of the virtual cameras.
      targets: the held-out close-ups.
      folder: folder to write to.
      scene: the scene.
      sources: the training photographs with their depths.
      settings: settings of poses and labels.
      render_depth: `camera -> [H, W]`, the depth that labels are made from.

    Returns:
      The pictures, for the report.
    """
    sample = jax.jit(sample_virtual_camera)
    sizes = scene.sizes("train")
    shots: list[tuple[str, Camera, jax.Array, Any, Any, tuple[int, int]]] = []
    for i, one in enumerate(jax.random.split(key, SHOWN_LABELS)):
        camera, index = sample(one, sources, settings)
        truth = scene.surface(camera).rgb if scene.surface else None
        # A virtual camera has the lens of its source, and as many pixels.
        shots.append(
            (f"virtual_{i}", camera, render_depth(camera), index, truth, sizes[int(index)])
        )
    nearest = jax.jit(best_source)
    for target in targets[:SHOWN_LABELS]:
        depth = render_depth(target.camera)
        index = nearest(target.camera, sources.views, sources.depths, depth=depth)
        own = target.rgb.shape[1::-1]
        shots.append((f"closeup_{target.name}", target.camera, depth, index, target.rgb, own))
    pictures = []
    for name, camera, depth, index, truth, (width, height) in shots:
        pixels = pixel_grid(camera.height, camera.width)
        label = label_pixels(camera, pixels, depth, index, sources, settings)
        kept = np.where(label.weight[..., None] > 0, label.rgb, 0)
        panels = {"backward warp": label.backward, "forward warp": label.forward, "kept": kept}
        panels["mask"] = np.repeat(np.asarray(label.weight)[..., None], 3, axis=-1)
        panels["rendered depth"] = colorize_depth(depth, near=scene.near, far=scene.far)
        if truth is not None:
            panels["truth"] = np.asarray(truth)
        image = _row({title: panel[:height, :width] for title, panel in panels.items()})
        write_png(folder / f"{name}.png", image)
        source = scene.names["train"][int(index)]
        pictures.append(Picture("Pseudo-labels", f"{name}, from {source}", image))
    return pictures
