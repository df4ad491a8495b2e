"""Native gathering, for CPUs: photographs are culled and ranked by blocks of neighboring pixels.

It does what `gather_sums` does, with the same arithmetic (`native/gather_block.cc`). Values are
read as they are stored, and only where a photograph's weight changes the mean.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.native import library
from jaxcloseup.photos.depth_maps import GatherSources
from jaxcloseup.photos.gather_sums import Gathered, GatherSettings
from jaxcloseup.photos.pyramids import Pyramid


# As in `native/gather.h`.
_MOST_PARTS, _MOST_CHANNELS, _MOST_LEVELS = 4, 512, 16
_MOST_SIDE = 2**15  # of a depth map


def can_gather(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    sources: GatherSources,
    pyramid: Pyramid,
    parts: int,
) -> bool:
    """Return whether the native library is there and gathers such arrays into so many parts."""
    cameras = camera, sources.cameras
    floats = [pixels, depth, sources.maps, pyramid.intrinsics]
    floats += [array for of in cameras for array in (of.camtoworld, of.intrinsics)]
    values, maps = pyramid.values, sources.maps
    return (
        library.available()
        and all(array.dtype == jnp.float32 for array in floats)
        and values.dtype in (jnp.int8, jnp.uint8, jnp.float32)
        and len(pyramid) == maps.shape[0] > 0
        and min(maps.shape[1:3]) > 2
        and max(maps.shape[1:3]) < _MOST_SIDE
        and 0 < values.shape[0] < 2**31
        and parts <= min(_MOST_PARTS, values.shape[1])
        and values.shape[1] <= _MOST_CHANNELS
        and pyramid.extents.shape[1] <= _MOST_LEVELS
        and maps.shape[1:3] == (sources.cameras.height + 2, sources.cameras.width + 2)
    )


def gather_image(
    camera: Camera,
    pixels: jax.Array,
    depth: jax.Array,
    sources: GatherSources,
    pyramid: Pyramid,
    settings: tuple[GatherSettings, ...],
    *,
    finest: jax.Array,
    exclude: jax.Array,
) -> tuple[Gathered, ...]:
    """Gather as `gather.gather_parts`, without derivatives; `can_gather` must be true.

    Args:
      camera: camera of the view.
      pixels: `[..., 2]` pixel centers of the view.
      depth: `[...]` their z-depth; 0 is undefined.
      sources: depth maps of the photographs.
      pyramid: values of the same photographs, one part of their channels after the other.
      settings: of each part.
      finest: `[]` int32, the first level to read.
      exclude: `[]` int32, index of a photograph to leave out; -1 leaves out none.
    """
    channels = pyramid.values.shape[-1] // len(settings)
    image = jax.ShapeDtypeStruct(depth.shape, jnp.float32)
    mean = jax.ShapeDtypeStruct((*depth.shape, channels), jnp.float32)
    part = [mean if field == "mean" else image for field in Gathered._fields]
    function = jax.ffi.ffi_call("jaxcloseup_gather", part * len(settings), vmap_method="sequential")
    results = function(
        *(camera.camtoworld, camera.intrinsics, pixels, depth),
        *(sources.cameras.camtoworld, sources.cameras.intrinsics),
        *(sources.maps, pyramid.values, pyramid.intrinsics, pyramid.extents, finest, exclude),
        settings=np.asarray(settings, np.float32).reshape(-1),
    )
    fields = len(Gathered._fields)
    return tuple(Gathered(*results[fields * i : fields * (i + 1)]) for i in range(len(settings)))
