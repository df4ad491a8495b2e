"""Draw the pictures of a run: its stages beside the true images, and its pseudo-labels."""

import pathlib
from collections.abc import Callable, Mapping, Sequence

import cv2
import jax
import numpy as np

from jaxcloseup.app.report.page import Picture
from jaxcloseup.app.score.metrics_text import REDUCED, SPLIT_TITLES
from jaxcloseup.app.score.targets import Target
from jaxcloseup.artifacts.images import colorize_depth, colorize_error, side_by_side, write_png
from jaxcloseup.captures.load import Scene
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.labels.make import (
    LabelSources,
    PseudoLabel,
    PseudoSettings,
    label_pixels,
    sample_virtual_camera,
)
from jaxcloseup.labels.target_views import best_source
from jaxcloseup.photos.views import to_float


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
    has no pictures, for example if all arms of a sweep failed.

    Args:
      folder: folder to write to.
      targets: held-out views by split.
      images: rendered colors, uint8 or float in [0, 1], by (stage, split), then by the view's name.
      in_report: stages that the report shows; default: all.

    Returns:
      The pictures, reduced for the report.
    """
    pictures: list[Picture] = []
    written: set[str] = set()
    # Reduced views show the same, smaller.
    shown = {split: views for split, views in targets.items() if not split.endswith(REDUCED)}
    for split, views in shown.items():
        stages = [stage for stage, rendered in images if rendered == split]
        for target in views if stages else ():
            seen = {stage: to_float(images[stage, split][target.name]) for stage in stages}
            name = f"{split}_{target.name}" if target.name in written else target.name
            written.add(name)
            truth = np.asarray(to_float(target.rgb))
            write_png(folder / f"{name}.png", _comparison(truth, seen))
            brief = {stage: seen[stage] for stage in stages if stage in (in_report or stages)}
            section = SPLIT_TITLES[split]
            small = {stage: fit_page(image) for stage, image in brief.items()}
            row = _comparison(fit_page(truth), small)
            pictures.append(Picture(section, target.name, row, f"{folder.name}/{name}.png"))
    return pictures


def _comparison(truth: np.ndarray, seen: Mapping[str, np.ndarray]) -> np.ndarray:
    """Draw the true image, the render of each stage in `seen`, and the error of the last one."""
    last = list(seen)[-1]
    error = colorize_error(np.abs(seen[last] - truth).mean(axis=-1))
    return _row({"truth": truth, **seen, f"error of {last}": error})


def _row(panels: Mapping[str, np.ndarray | jax.Array]) -> np.ndarray:
    return side_by_side(map(enlarge, panels.values()), labels=list(panels))


def fit_page(image: np.ndarray, most: int = 320) -> np.ndarray:
    """Return an image `[H, W, ...]` that is at most `most` wide, by averaging areas."""
    height, width = image.shape[:2]
    if width <= most:
        return image
    size = (most, max(1, round(height * most / width)))
    return cv2.resize(np.asarray(image), size, interpolation=cv2.INTER_AREA)


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
    sample, nearest = jax.jit(sample_virtual_camera), jax.jit(best_source)
    sizes, pictures = scene.sizes("train"), []

    def draw(
        name: str,
        camera: Camera,
        depth: jax.Array,
        source: jax.Array,
        truth: jax.Array | None,
        size: Sequence[int],
    ) -> None:
        pixels = pixel_grid(camera.height, camera.width)
        label = label_pixels(camera, pixels, depth, source, sources, settings)
        panels = _label_panels(label, depth, truth, scene)
        width, height = size  # without padding
        image = _row({title: panel[:height, :width] for title, panel in panels.items()})
        write_png(folder / f"{name}.png", image)
        photograph = scene.names["train"][int(source)]
        pictures.append(Picture("Pseudo-labels", f"{name}, from {photograph}", image))

    for i, camera_key in enumerate(jax.random.split(key, SHOWN_LABELS)):
        camera, source = sample(camera_key, sources, settings)
        truth = scene.surface(camera).rgb if scene.surface else None
        # A virtual camera has the lens and the size of its source.
        draw(f"virtual_{i}", camera, render_depth(camera), source, truth, sizes[int(source)])
    for target in targets[:SHOWN_LABELS]:
        camera, depth = target.camera, render_depth(target.camera)
        source = nearest(camera, sources.views, sources.depths, depth=depth)
        draw(f"closeup_{target.name}", camera, depth, source, target.rgb, target.weight.shape[::-1])
    return pictures


def _label_panels(
    label: PseudoLabel, depth: jax.Array, truth: jax.Array | None, scene: Scene
) -> dict[str, np.ndarray | jax.Array]:
    """Return the panels `[H, W, 3]` that show how a label is made, by title."""
    panels: dict[str, np.ndarray | jax.Array] = {
        "backward warp": label.backward,
        "forward warp": label.forward,
        "kept": np.where(label.weight[..., None] > 0, label.rgb, 0),
        "mask": np.repeat(np.asarray(label.weight)[..., None], 3, axis=-1),
        "rendered depth": colorize_depth(depth, near=scene.near, far=scene.far),
    }
    return panels if truth is None else panels | {"truth": np.asarray(truth)}
