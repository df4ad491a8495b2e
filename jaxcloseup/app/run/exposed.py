"""Renders at the exposure at which the camera would have taken them."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.app.run.programs import Programs
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.exposures import predict_gain
from jaxcloseup.photos.light import change_exposure
from jaxcloseup.training.state import TrainState


_predict_gain = jax.jit(predict_gain)
_change_exposure = jax.jit(change_exposure)


def known_gain(programs: Programs, split: str | None, name: str) -> jax.Array | None:
    """Return the gain `[3]` of a photograph of a split; None where nothing states it."""
    exposures = programs.exposures
    if exposures is None:
        return None
    if split == "train":
        return jnp.exp(exposures.log_gains[programs.scene.names["train"].index(name)])
    log_gain = exposures.stated.get(split or "", {}).get(name)
    return None if log_gain is None else jnp.exp(log_gain)


def expose(programs: Programs, rgb: Any, seen: Rendering, gain: jax.Array | None = None) -> Any:
    """Return colors of a whole image as the camera would have taken them.

    Args:
      programs: what rendered it; `programs.gain` is that of all views, if it is not None.
      rgb: `[H, W, 3]` colors at the middle exposure, such as those with detail.
      seen: the rendering of the view.
      gain: `[3]` of the view, see `known_gain`; None: predicted from `seen`.
    """
    if programs.exposures is None:
        return rgb
    gain = gain if programs.gain is None else programs.gain
    if gain is None:
        gain = _predict_gain(programs.exposures.metering, seen.rgb, seen.alpha)
    return _change_exposure(rgb, gain[None, None])


def render_exposed(
    programs: Programs, state: TrainState, camera: Camera, gain: jax.Array | None = None
) -> Rendering:
    """Render a whole image at its exposure, see `expose`."""
    seen = programs.render(state, camera)
    return seen._replace(rgb=expose(programs, seen.rgb, seen, gain))
