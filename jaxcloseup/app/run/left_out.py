"""What photographs tell of detail when the others show them."""

from typing import NamedTuple

import numpy as np

from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.score.expected_errors import PixelErrors, error_tenths, pixel_errors
from jaxcloseup.detail.add import Detail, add_to_rendering, leave_out
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.views import camera_at, to_float
from jaxcloseup.training.state import TrainState


_COUNT = 8  # photographs that are left out


class LeftOut(NamedTuple):
    """What photographs tell that are left out.

    Attributes:
      error_scale: how many times as large as the networks expect errors are, 1 or more, where all
        their detail is added.
      confirmed: part of the networks' detail that is added.
    """

    error_scale: float
    confirmed: float


def check_left_out(
    programs: Programs, state: TrainState, detail: Detail, pyramid: Pyramid
) -> LeftOut:
    """Show photographs by what the others add to their renders, and compare.

    The networks learned from drawn scenes, whose poses and colors are exact. Photographs of a real
    scene differ by more than its detail, and each tells so when the others show it. The field has
    learned from it, too. So less of the detail is missing there than in other views, and only half
    of what is not confirmed is left out; and errors are never expected smaller than without.
    """
    count = len(pyramid)
    views = sorted({round(view) for view in np.linspace(0, count - 1, _COUNT)})
    shown = [_show_left_out(programs, state, detail, pyramid, view) for view in views]
    added, missing = (
        np.concatenate([getattr(view, name).ravel() for view in shown])
        for name in ("added", "missing")
    )
    best = np.sum(added * missing) / max(np.sum(added**2), 1e-12)
    confirmed = (1 + float(np.clip(best, 0, 1))) / 2
    found = map(np.concatenate, zip(*(view.errors for view in shown), strict=True))
    ratios = [row["actual"] / row["expected"] for row in error_tenths(*found)]
    return LeftOut(max(1.0, float(np.median(ratios))) if ratios else 1.0, confirmed)


class _Shown(NamedTuple):
    """A photograph that others show.

    Attributes:
      added: `[H, W, 3]` what they add to its render, with the photograph's weight.
      missing: `[H, W, 3]` what the render lacks, with the same weight.
      errors: expected and actual errors of the render with all that they add.
    """

    added: np.ndarray
    missing: np.ndarray
    errors: PixelErrors


def _show_left_out(
    programs: Programs, state: TrainState, detail: Detail, pyramid: Pyramid, view: int
) -> _Shown:
    level = pyramid.sizes.index(detail.sources.trust.shape[1:])
    camera = pyramid.camera(camera_at(programs.scene.train.cameras, view), view, level)
    rendering, photograph = programs.render(state, camera), pyramid.image(view, level)
    seen = add_to_rendering(leave_out(detail, view), camera, rendering, far=programs.scene.far)
    truth, rgb = to_float(np.asarray(photograph)), np.clip(rendering.rgb, 0, detail.brightest)
    # Holes that are filled are no detail.
    weight = np.sqrt(np.where(seen.weight > 0, truth[..., 3], 0))[..., None]
    added, missing = weight * (seen.rgb - rgb), weight * (truth[..., :3] - rgb)
    return _Shown(added, missing, pixel_errors(seen, truth[..., :3], truth[..., 3]))
