"""Renders at the exposure at which the camera would have taken them."""

from typing import Any

import jax

from jaxcloseup.app.run.programs import Programs
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.exposures import predict_gain
from jaxcloseup.photos.light import change_exposure
from jaxcloseup.training.state import TrainState


_predict_gain = jax.jit(predict_gain)
_change_exposure = jax.jit(change_exposure)


def expose(programs: Programs, rgb: Any, seen: Rendering) -> Any:
    """Return colors of a whole image as the camera would have taken them.

    Args:
      programs: what rendered it; `programs.gain` is that of all views, if it is not None.
      rgb: `[H, W, 3]` colors at the middle exposure, such as those with detail.
      seen: the rendering of the view, whose exposure is predicted.
    """
    if programs.exposures is None:
        return rgb
    gain = programs.gain
    if gain is None:
        gain = _predict_gain(programs.exposures.metering, seen.rgb, seen.alpha)
    return _change_exposure(rgb, gain[None, None])


def render_exposed(programs: Programs, state: TrainState, camera: Camera) -> Rendering:
    """Render a whole image at its exposure."""
    seen = programs.render(state, camera)
    return seen._replace(rgb=expose(programs, seen.rgb, seen))
