"""Errors of pseudo-labels from exact depth on the built-in scenes, and their upper bound.

The suite labels random virtual close-ups, magnified 2 to 8 times. `error` is the mean absolute
difference between kept labels and the true close-up, blurred to the source photograph's pixels.
`kept` is the share of the pixels seen by the source that keep a label. The bound is the PSNR of the
true test close-ups, blurred to the detail of the nearest photograph. The results.json of each run
holds the same figures for trained depth.
"""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from experiments.studies.tables import SCENES
from jaxcloseup.app.report.pictures import label_pictures
from jaxcloseup.app.score.audit import audit_labels
from jaxcloseup.app.score.footprints import resolved_by_photographs
from jaxcloseup.app.score.targets import exact_depths
from jaxcloseup.captures.load import load_scene
from jaxcloseup.labels.config import LabelConfig, pseudo_settings
from jaxcloseup.labels.make import label_sources
from jaxcloseup.metrics.image_metrics import psnr
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import camera_at, to_float


DOWNSCALE = 4
PICTURES = pathlib.Path("outputs/labels")
MASKS = {
    "paper": {},
    "no mask": {"use_mask": False},
    "paper, depth check 5 %": {"depth_tolerance": 0.05},
}


def run() -> None:
    """Print error, kept and leaked shares by scene and mask, and write pictures of labels."""
    print(f"labels from exact depth at 1/{DOWNSCALE} of the full size")
    print(f"{'scene':>8}  {'mask':<22}  {'error':>6}  {'kept':>6}  {'leaked':>6}")
    for name in SCENES:
        scene = load_scene(name, downscale=DOWNSCALE)
        scene = dataclasses.replace(scene, train=jax.device_put(scene.train))
        exact = exact_depths(scene, scene.train.cameras)
        sources = label_sources(scene.train, exact)
        render_depth = jax.jit(lambda camera, scene=scene: scene.surface(camera).depth)
        for mask, changes in MASKS.items():
            settings = pseudo_settings(LabelConfig(**changes))
            key = jax.random.key(0)
            found = audit_labels(key, exact, scene, sources, settings, render_depth=render_depth)
            print(
                f"{name:>8}  {mask:<22}  {found['error']:>6.4f}  {found['kept']:>6.1%}"
                f"  {found['leaked']:>6.1%}",
                flush=True,
            )
        bounds = f"{_bound(scene, exact):.2f} dB, at 1/{2 * DOWNSCALE} {_quick_bound(name):.2f} dB"
        print(f"{name:>8}  upper bound on close-ups: {bounds}", flush=True)
        label_pictures(
            jax.random.key(1),
            [],
            PICTURES / name,
            scene=scene,
            sources=sources,
            settings=pseudo_settings(LabelConfig()),
            render_depth=render_depth,
        )
    print(f"pictures: {PICTURES}")


def _quick_bound(name: str) -> float:
    """Return the upper bound at the size of the quick presets."""
    scene = load_scene(name, downscale=2 * DOWNSCALE)
    return _bound(scene, exact_depths(scene, scene.train.cameras))


def _bound(scene: Scene, exact: jax.Array) -> float:
    """Return the mean PSNR of the test close-ups at the photographs' detail, where seen."""
    views = scene.test
    found = []
    for i in range(len(views)):
        best, seen = resolved_by_photographs(scene, camera_at(views.cameras, i), exact)
        best, weight = (jnp.asarray(array, jnp.float32) for array in (best, seen))
        found.append(float(psnr(best, to_float(jnp.asarray(views.rgb[i])), weight=weight)))
    return float(np.mean(found))
