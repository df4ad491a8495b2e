"""At which sizes a run reads its photographs, and how programs say it."""

import dataclasses
import math

from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.photos.pyramids import Pyramid
from jaxcloseup.photos.scene import Scene


def finest_read(preset: Preset, scene: Scene) -> int:
    """Return the divisor of the finest photographs that steps read.

    It is larger than the preset's where stage 1 would not read each pixel about once: what finer
    photographs show is left to detail.
    """
    views, divisor = scene.train, scene.metadata.get("downscale", 1)
    if preset.windows is None:
        return divisor
    if METHODS[preset.method].renders_pixels:
        return preset.windows.finest
    each = views.cameras.height * views.cameras.width
    read = preset.baseline_steps * preset.train.num_windows * each
    times = math.sqrt(views.weight.size * divisor**2 / read)
    return max(preset.windows.finest, math.ceil(times - 0.5))


def bound_filter(preset: Preset, scene: Scene) -> Preset:
    """Return the preset whose filter in space is no finer than the photographs that steps read."""
    divisor = getattr(preset.field, "smoothed_at", None)
    if divisor is None:
        return preset
    bounded = max(divisor, finest_read(preset, scene))
    return dataclasses.replace(preset, field=dataclasses.replace(preset.field, smoothed_at=bounded))


def describe_training(preset: Preset, scene: Scene) -> str:
    """Return in one line what a run reads: photographs, their sizes, and why these."""
    size, metadata = scene.train.cameras, scene.metadata
    divisor = metadata.get("downscale", 1) * metadata.get("zoom", 1)
    text = f"{scene.name}: {len(scene.train)} training photographs of {size.width} x {size.height}"
    if divisor > 1:
        text += f", 1 / {divisor} of their size"
    if preset.downscale is None:
        text += f", so that a step reads about {preset.step_pixels} pixels"
    return f"{text}; depth {scene.near:.3g} to {scene.far:.3g}"


def describe_photographs(pyramid: Pyramid, divisor: int) -> str:
    """Return in words what the finest level of `Programs.pyramid` is."""
    height, width = pyramid.sizes[0]
    share = f"1 / {divisor} of their size" if divisor > 1 else "their own size"
    return f"photographs of {width} x {height} pixels, {share}"
