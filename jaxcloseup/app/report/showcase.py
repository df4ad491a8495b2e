"""Held-out close-ups beside the photographs that show the same places best."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np

from jaxcloseup.app.score.scores import Target
from jaxcloseup.artifacts.images import to_uint8
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_points, points_to_pixels
from jaxcloseup.labels.make import LabelSources, best_source
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.views import camera_at


class Exhibit(NamedTuple):
    """A close-up, as it is, as it is rendered, and as a photograph shows it.

    Attributes:
      name: of the held-out view.
      psnr: of its render, in dB.
      render: uint8 `[H, W, 3]`.
      truth: uint8 `[H, W, 3]`.
      photograph: name of the training photograph that shows most of it.
      cutout: uint8 `[H, W, 3]`, the part of that photograph that shows the same; None if it could
        not be found.
      pixel: side of that photograph's pixels, in pixels of the close-up.
    """

    name: str
    psnr: float
    render: np.ndarray
    truth: np.ndarray
    photograph: str
    cutout: np.ndarray | None
    pixel: float


def best_middle_worst(psnr: Mapping[str, float]) -> list[str]:
    """Names of the views with the highest, the middle and the lowest PSNR; fewer if there are."""
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
    """The close-ups with the highest, the middle and the lowest PSNR.

    Args:
      targets: held-out close-ups.
      renders: their renders by name, float `[H, W, 3]`.
      psnr: PSNR of these by name.
      render_depth: `camera -> [H, W]`, the model's z-depth.
      sources: the training photographs with their depths.
      photographs: the same at finer sizes.
      names: names of the training photographs.
    """
    by_name = {target.name: target for target in targets}
    nearest, found = jax.jit(best_source), []
    for name in best_middle_worst(psnr):
        target = by_name[name]
        depth = render_depth(target.camera)
        view = int(nearest(target.camera, sources.views, sources.depths, depth=depth))
        camera = photographs.camera(camera_at(sources.views.cameras, view), view, 0)
        height, width = target.weight.shape
        own = target.camera.replace(height=height, width=width)  # without padding
        place = find_place(own, depth[:height, :width], camera)
        cutout, pixel = None, float("nan")
        if place is not None:
            pixel = 1 / np.sqrt(abs(np.linalg.det(place[:, :2])))
            cutout = cut_out(photographs, view, place, own)
        images = map(to_uint8, (renders[name], np.asarray(target.rgb)))
        found.append(Exhibit(name, psnr[name], *images, names[view], cutout, pixel))
    return found


def find_place(camera: Camera, depth: jax.Array, photograph: Camera) -> np.ndarray | None:
    """Where a photograph shows what a camera sees: the similarity that fits most pixels.

    Args:
      camera: of `H` x `W` pixels.
      depth: `[H, W]` its z-depth; 0 is undefined.
      photograph: camera of the photograph.

    Returns:
      `[2, 3]` from pixels of the camera to those of the photograph, or None if it shows nothing.
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
def _land(photograph, camera, pixels, depth):
    return points_to_pixels(photograph, pixels_to_points(camera, pixels, depth))


def cut_out(photographs: Pyramid, view: int, place: np.ndarray, camera: Camera) -> np.ndarray:
    """The part of a photograph that a camera sees, uint8 `[H, W, 3]`; black where it ends.

    Args:
      photographs: at several sizes, finest first.
      view: which of them.
      place: of `find_place`, for the finest size.
      camera: of `H` x `W` pixels.
    """
    scale = np.sqrt(abs(np.linalg.det(place[:, :2])))
    coarser = 2 ** np.asarray(photographs.coarseness(view))
    # Interpolation alone would skip pixels of a size that is finer than the camera's.
    level = max(i for i, times in enumerate(coarser) if i == 0 or times <= scale)
    fine, own = (np.asarray(photographs.intrinsics[view, i]) for i in (0, level))
    ratio = own[:2] / fine[:2]
    inner = place * ratio[:, None]
    inner[:, 2] += own[2:] - ratio * fine[2:]
    # OpenCV's pixel centers lie at integers.
    inner[:, 2] += inner[:, :2].sum(axis=1) / 2 - 0.5
    image = to_uint8(np.asarray(photographs.image(view, level))[..., :3])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, inner, (camera.width, camera.height), flags=flags)
