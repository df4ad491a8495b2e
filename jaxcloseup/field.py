"""The one contract between renderers and everything above them.

A radiance field is a bundle of pure functions. `pseudo`, `train` and the experiments know this file
and no concrete field, so a NeRF, a splatter or a user's own renderer can be fine-tuned alike.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax


class Rendering(NamedTuple):
    """What a field renders; `[...]` is the pixels' shape, or `[H, W]` for a whole image.

    Attributes:
      rgb: `[..., 3]` colours, background included.
      depth: `[...]` expected z-depth of the surface in world units; 0 where alpha is 0.
      alpha: `[...]` accumulated opacity in [0, 1].
      aux: any pytree, private to its field.
    """

    rgb: jax.Array
    depth: jax.Array
    alpha: jax.Array
    aux: Any = ()


class RadianceField(NamedTuple):
    """Pure functions that make a renderer trainable.

    Attributes:
      init: `(key, points[P, 3], rgb[P, 3]) -> (params, buffers)`. Only `params` is differentiated.
      render: `(params, buffers, camera, pixels[..., 2] | None, key | None) -> Rendering`. `pixels`
        None renders the whole image; `key` None is deterministic. A field that renders single
        pixels also takes stacked cameras `[N]`, one for each of `pixels[N, 2]`.
      loss: `(rendering, target_rgb, weight) -> (scalar, metrics)`, a weighted mean over pixels that
        is 0, not NaN, where no pixel weighs anything.
      adapt: `(key, state) -> state`, density control or occupancy refresh; identity by default.
    """

    init: Callable[..., tuple[Any, Any]]
    render: Callable[..., Rendering]
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]]
    adapt: Callable[..., Any] = lambda key, state: state
