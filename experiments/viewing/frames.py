"""What becomes of cameras to render: fine-tuning for them, and pictures of what they see."""

import functools
import pathlib
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from experiments.methods.presets import pseudo_settings, test_time_steps
from experiments.training.gate import print_gate, weigh_labels
from experiments.training.loop import Programs, TrainingError
from experiments.training.stages import rendered_depths
from experiments.viewing.camera_paths import Shots, one_by_one
from jaxcloseup.artifacts.images import (
    Image,
    colorize_depth,
    colorize_normals,
    colorize_support,
    write_png,
)
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.label_rules import label_depth
from jaxcloseup.pseudo import label_views
from jaxcloseup.scenes import Scene
from jaxcloseup.support import find_support
from jaxcloseup.train import TrainState


_support = jax.jit(find_support)


def fine_tune(
    programs: Programs, state: TrainState, depths: jax.Array, shots: Shots, *, most: int | None
) -> TrainState:
    """Train a state for the cameras that are to be rendered, with labels made once for them.

    Where the preset has a gate, it weighs the labels again.

    Args:
      programs: of the run.
      state: of which depth is rendered for the labels.
      depths: `[V, H, W]` of the training views, of this state.
      shots: the cameras.
      most: steps in all; by default the preset's, for each camera of surfels.
    """
    preset, scene = programs.preset, programs.scene
    render = functools.partial(programs.render, state)
    settings, views = pseudo_settings(preset), scene.train
    if preset.gated:
        settings, found = weigh_labels(views, depths, render, settings)
        print_gate(found)
        if not found["weight"]:
            print("nothing is fine-tuned")
            return state
    targets = rendered_depths(render, shots.cameras, scene, near=0.0)
    labels = jax.jit(label_views)(shots.cameras, targets, views, depths, settings)
    steps = test_time_steps(preset, len(shots.names))
    steps = min(steps, most or steps)
    coverage = float(jnp.mean(labels.weight))
    print(f"labels on {coverage:.0%} of the pixels to be rendered; {steps} steps", flush=True)
    if coverage == 0:
        print("nothing is fine-tuned")
        return state
    state, values = programs.run("targets", state, views, labels, settings, count=steps)
    if values["skipped"] == steps:
        raise TrainingError(f"loss or gradient was not finite in each of {steps} steps for them")
    numbers = {key: value for key, value in values.items() if isinstance(value, float)}
    print("  ".join(f"{key} {value:.4g}" for key, value in numbers.items()))
    return state


def render_shots(
    output_dir: pathlib.Path,
    programs: Programs,
    state: TrainState,
    shots: Shots,
    *,
    depths: jax.Array | None,
) -> list[pathlib.Path]:
    """Write `<kind>/<name>.png` for every camera; returns the folders.

    Args:
      output_dir: for `rgb`, `depth`, `normals` of surfels, and `support`.
      programs: of the run.
      state: what is rendered.
      shots: cameras.
      depths: `[V, H, W]` of the training views, or None for no support.
    """
    scene = programs.scene
    cameras = one_by_one(shots)
    # Depth has the colors of three frames in all of them, so that videos do not flicker.
    some = [programs.render(state, cameras[i][1]) for i in {0, len(cameras) // 2, len(cameras) - 1}]
    limits = depth_range([label_depth(one, near=0, far=scene.far) for one in some], scene)
    images: dict[str, Image] = {}
    for name, camera in cameras:
        images = pictures(programs, state, camera, depths=depths, limits=limits)
        for kind, image in images.items():
            write_png(output_dir / kind / f"{name}.png", image)
    return [output_dir / kind for kind in images]


def pictures(
    programs: Programs,
    state: TrainState,
    camera: Camera,
    *,
    depths: jax.Array | None,
    limits: tuple[float, float] | None = None,
) -> dict[str, Image]:
    """One camera's `rgb`, `depth`, `normals` of surfels, and `support`, in colors.

    Args:
      programs: of the run.
      state: what is rendered.
      camera: from where.
      depths: `[V, H, W]` of the training views, or None for no support.
      limits: depths of the extreme colors; by default most of this camera's.
    """
    scene = programs.scene
    seen = programs.render(state, camera)
    depth = label_depth(seen, near=0, far=scene.far)
    near, far = limits or depth_range([depth], scene)
    solid = np.asarray(seen.alpha) >= 0.5
    depth_colors = colorize_depth(seen.depth, near=near, far=far, valid=solid)
    images = {"rgb": seen.rgb, "depth": depth_colors}
    surfels = getattr(seen.aux, "surfels", None)
    if surfels is not None:
        images["normals"] = colorize_normals(np.where(solid[..., None], surfels.normal, 0))
    if depths is not None:
        pixels = pixel_grid(camera.height, camera.width)
        images["support"] = colorize_support(*_support(camera, pixels, depth, scene.train, depths))
    return images


def depth_range(depths: Sequence[jax.Array], scene: Scene) -> tuple[float, float]:
    """Near and far of most of these depths, 0 being undefined, or else the scene's."""
    known = np.concatenate([np.asarray(depth).ravel() for depth in depths])
    known = known[known > 0]
    if not len(known):
        return scene.near, scene.far
    low, high = np.percentile(known, [1, 99])
    return float(low), float(high)
