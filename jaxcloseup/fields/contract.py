"""The one contract between renderers and everything above them.

A radiance field is a bundle of pure functions. Labels, training and the programs know this file and
no concrete field, so they fine-tune a NeRF, a splatter or a renderer of yours alike.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax


class Rendering(NamedTuple):
    """Images or pixels of a field; `[...]` is the pixels' shape, or `[H, W]` for a whole image.

    Attributes:
      rgb: `[..., 3]` colors, background included.
      depth: `[...]` z-depth of the surface in world units; 0 where alpha is 0.
      alpha: `[...]` accumulated opacity in [0, 1].
      aux: any pytree, private to its field.
      normal: `[..., 3]` normals in the world's frame, towards the camera, of any length, from
        fields that have them; None from others.
      overflow: `[]` int32 number of items beyond the field's static capacity; None from fields
        without one. Where it is not 0 the image is wrong: render it again with a field of more
        capacity.
    """

    rgb: jax.Array
    depth: jax.Array
    alpha: jax.Array
    aux: Any = ()
    normal: jax.Array | None = None
    overflow: jax.Array | None = None


class Local(NamedTuple):
    """How steps touch only the part of a field that their cameras see.

    A state is prepared for many steps. The functions are called outside of `jax.jit`, since the
    size of a part differs from step to step.

    Attributes:
      prepare: `(state) -> state`, with what `take` needs; its arrays are copies.
      take: `(state, cameras) -> (part, place)`, a state of what the cameras may see, and where it
        belongs.
      adapt: `(key, part) -> part`, what every step changes besides.
      put: `(key, state, part, place) -> state`, with the part in its place. The arrays of the
        state before are given away.
      finish: `(state) -> state`, as it was before `prepare`, but for the order of its rows.
    """

    prepare: Callable[[Any], Any]
    take: Callable[[Any, Any], tuple[Any, Any]]
    adapt: Callable[[jax.Array, Any], Any]
    put: Callable[[jax.Array, Any, Any, Any], Any]
    finish: Callable[[Any], Any]


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
      gradient_chunk: pixels that training differentiates at once, see `rendered_loss`; None for
        all. With chunks, every array that `render` returns is per pixel.
      depth_loss: `(rendering, depth, trust) -> scalar`, a mean over all pixels, of which `Measured`
        knows the depth of some, of a rendering with a key; None for fields that learn no depth so.
      local: for fields of which a view can change a part alone; None where it can change all.
    """

    init: Callable[..., tuple[Any, Any]]
    render: Callable[..., Rendering]
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]]
    adapt: Callable[..., Any] = lambda key, state: state
    gradient_chunk: int | None = None
    depth_loss: Callable[..., jax.Array] | None = None
    local: Local | None = None
