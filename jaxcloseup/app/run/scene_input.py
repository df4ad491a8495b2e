"""The scene that programs train on, checked before any work."""

from collections.abc import Mapping
from typing import Any

from jaxcloseup.captures.load import load_scene
from jaxcloseup.metrics.image_metrics import SSIM_TAPS
from jaxcloseup.photos.scene import Scene, SceneError


def load(name: str, options: Mapping[str, Any]) -> Scene:
    """Return a built-in scene or a capture; print notes about what was read.

    Raises:
      SceneError: one sentence that says what to do, also for photographs too small for SSIM.
    """
    scene = load_scene(name, **options)
    size = (scene.train.cameras.width, scene.train.cameras.height)
    sizes = scene.metadata.get("sizes", {"train": [size]})
    width, height = min((size for part in sizes.values() for size in part), key=min)
    if min(width, height) < SSIM_TAPS:
        raise SceneError(
            f"{name}: a photograph has {width} x {height} pixels, but SSIM needs {SSIM_TAPS} a "
            "side: choose a smaller --downscale or --zoom, or larger photographs."
        )
    for note in scene.metadata.get("notes", ()):
        print(note)
    return scene
