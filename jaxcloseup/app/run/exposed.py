"""Renders at the exposure at which the camera would have taken them."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxcloseup.app.run.programs import Programs
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.exposures import Taken, predict_gain, take
from jaxcloseup.training.state import TrainState


_predict_gain = jax.jit(predict_gain)
_take = jax.jit(take)


def how_taken(programs: Programs, split: str | None, name: str | None) -> Taken | None:
    """Return how a photograph of a split was taken, or a view of no split would be.

    Its gain is None where nothing states it; None where all photographs have one exposure.
    """
    exposures = programs.exposures
    if exposures is None:
        return None
    log_gain = exposures.stated.get(split or "", {}).get(name or "")
    if split == "train" and name:
        log_gain = exposures.log_gains[programs.scene.names["train"].index(name)]
    gain = None if log_gain is None else jnp.exp(log_gain)
    return Taken(gain, exposures.curve_of(split, name))


def expose(programs: Programs, rgb: Any, seen: Rendering, taken: Taken | None = None) -> Any:
    """Return colors of a whole image as the camera would have taken them.

    Args:
      programs: what rendered it; `programs.taken` goes for all views, if it is not None.
      rgb: `[H, W, 3]` colors at the middle exposure, such as those with detail.
      seen: the rendering of the view, from which a gain that is not known is predicted.
      taken: how the view was taken; None: as a view of no photograph.
    """
    if programs.exposures is None:
        return rgb
    taken = programs.taken or taken or how_taken(programs, None, None)
    assert taken is not None
    if taken.gain is None:
        gain = _predict_gain(programs.exposures.metering, seen.rgb, seen.alpha)
        taken = taken._replace(gain=gain)
    return _take(rgb, taken)


def render_exposed(
    programs: Programs, state: TrainState, camera: Camera, taken: Taken | None = None
) -> Rendering:
    """Render a whole image at its exposure, see `expose`."""
    seen = programs.render(state, camera)
    return seen._replace(rgb=expose(programs, seen.rgb, seen, taken))
