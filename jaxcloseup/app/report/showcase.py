"""Held-out close-ups beside the photographs that show the same places best."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np

from jaxcloseup.app.score.targets import Target
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.labels.make import LabelSources
from jaxcloseup.labels.target_views import best_source
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.views import camera_at


class Exhibit(NamedTuple):
    """A close-up: its true image, its render, and a photograph of the same place."""

    name: str  # name of the held-out view
    psnr: float  # PSNR of its render, in dB
    render: np.ndarray  # uint8 `[H, W, 3]`
    truth: np.ndarray  # uint8 `[H, W, 3]`
    photograph: str  # name of the training photograph that shows most of it
    # uint8 `[H, W, 3]`, the part of that photograph that shows the same; None where no similarity
    # fits
    cutout: np.ndarray | None
    pixel: float  # side of that photograph's pixels, in pixels of the close-up

    @property
    def pixel_size(self) -> str:
        """Describe how large the photograph's pixels are in the close-up."""
        if self.pixel < 1:
            return f"whose pixels are {1 / self.pixel:.1f} times finer"
        return f"whose pixels are {self.pixel:.1f} times as large"


def best_middle_worst(psnr: Mapping[str, float]) -> list[str]:
    """Return the views with the highest, the middle and the lowest PSNR, each once."""
    names = sorted(psnr, key=lambda name: -psnr[name])
    return [names[i] for i in sorted({0, len(names) // 2, len(names) - 1})] if names else []


def exhibits(
    targets: Sequence[Target],
    renders: Mapping[str, np.ndarray],
    psnr: Mapping[str, float],
    *,
    render_depth: Callable[[Camera], jax.Array],
    sources: LabelSources,
    photographs: Pyramid,
    names: Sequence[str],
) -> list[Exhibit]:
    """Return the close-ups with the highest, the middle and the lowest PSNR.

    Args:
      targets: held-out close-ups.
      renders: their renders by name, uint8 or float `[H, W, 3]`.
      psnr: PSNR of the renders by name.
      render_depth: `camera -> [H, W]`, the model's z-depth.
      sources: the training photographs with their depths.
      photographs: the training photographs at finer sizes.
      names: names of the training photographs.
    """
    by_name = {target.name: target for target in targets}
    nearest, shown = jax.jit(best_source), []
    for name in best_middle_worst(psnr):
        target = by_name[name]
        depth = render_depth(target.camera)
        view = int(nearest(target.camera, sources.views, sources.depths, depth=depth))
        photograph = photographs.camera(camera_at(sources.views.cameras, view), view, 0)
        place = find_place(target.camera, depth, photograph)
        cutout, pixel = None, float("nan")
        if place is not None:
            pixel = 1 / _scale(place)
            cutout = cut_out(photographs, view, place, target.camera)
        render, truth = to_uint8(renders[name]), to_uint8(np.asarray(target.rgb))
        shown.append(Exhibit(name, psnr[name], render, truth, names[view], cutout, pixel))
    return shown


def find_place(camera: Camera, depth: jax.Array, photograph: Camera) -> np.ndarray | None:
    """Fit the similarity that maps most pixels of a camera to where a photograph shows them.

    Args:
      camera: camera of `H` x `W` pixels.
      depth: `[H, W]` its z-depth; 0 is undefined.
      photograph: camera of the photograph.

    Returns:
      `[2, 3]` from the camera's pixels to the photograph's, or None if it shows nothing.
    """
    pixels = pixel_grid(camera.height, camera.width)
    landed, ahead = _land(photograph, camera, pixels, depth)
    seen = (np.asarray(depth) > 0) & (np.asarray(ahead) > 0)
    some = np.flatnonzero(seen)[:: max(1, int(seen.sum()) // 2000)]
    if len(some) < 3:
        return None
    here, there = (np.asarray(points).reshape(-1, 2)[some] for points in (pixels, landed))
    return cv2.estimateAffinePartial2D(here, there, method=cv2.LMEDS)[0]


@jax.jit
def _land(
    photograph: Camera, camera: Camera, pixels: jax.Array, depth: jax.Array
) -> tuple[jax.Array, jax.Array]:
    return points_to_pixels(photograph, pixels_to_points(camera, pixels, depth))


def cut_out(photographs: Pyramid, view: int, place: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the part of a photograph that a camera sees, uint8 `[H, W, 3]`; black outside it.

    Args:
      photographs: photographs at several sizes, finest first.
      view: index of the photograph.
      place: result of `find_place` for the finest size.
      camera: camera of `H` x `W` pixels.
    """
    coarser = 2 ** np.asarray(photographs.coarseness(view))
    # Interpolation alone would skip pixels of a size that is finer than the camera's.
    level = max(i for i, times in enumerate(coarser) if i == 0 or times <= _scale(place))
    finest, chosen = (np.asarray(photographs.intrinsics[view, i]) for i in (0, level))
    ratio = chosen[:2] / finest[:2]
    inner = place * ratio[:, None]
    inner[:, 2] += chosen[2:] - ratio * finest[2:]
    # OpenCV's pixel centers lie at integers.
    inner[:, 2] += inner[:, :2].sum(axis=1) / 2 - 0.5
    image = to_uint8(np.asarray(photographs.image(view, level))[..., :3])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, inner, (camera.width, camera.height), flags=flags)


def _scale(place: np.ndarray) -> float:
    """Return by how much a similarity `[2, 3]` enlarges."""
    return float(np.sqrt(abs(np.linalg.det(place[:, :2]))))
