"""Labels of a run: the depths and photographs that they are made from, and labeled views."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from jaxcloseup.app import progress
from jaxcloseup.app.run.kept_detail import GetDetail, detailed_views
from jaxcloseup.app.run.keys import RunKeys
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.labels.config import LabelConfig, pseudo_settings
from jaxcloseup.labels.make import LabelSources, PseudoSettings, label_sources, sample_closeups
from jaxcloseup.labels.rules import LABEL_RULES, label_depth
from jaxcloseup.labels.target_views import label_views, render_depths
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Views
from jaxcloseup.training.state import TrainState


_MOST_CLOSEUPS = 200  # that are labeled before the first step


class LabelStart(NamedTuple):
    """What fine-tuning on labels begins with."""

    state: TrainState  # that of the baseline, rendering the depth that labels are made from
    sources: LabelSources  # the training photographs with this state's depths


def start_labels(
    programs: Programs, state: Any, *, expected_depth: bool | None = None
) -> LabelStart:
    """Return the state whose depth labels are made from, and the photographs with its depths."""
    if expected_depth is not None:
        assert programs.method.with_expected_depth is not None  # settings are checked before
        buffers = programs.method.with_expected_depth(state.buffers, expected_depth)
        state = state.replace(buffers=buffers)
    scene, rule = programs.scene, LABEL_RULES[programs.preset.train.label_rule]
    depths = rendered_depths(
        functools.partial(programs.render, state),
        scene.train.cameras,
        scene,
        near=scene.near,
        depth=rule.depth,
        sizes=scene.sizes("train"),
    )
    return LabelStart(state, jax.jit(label_sources)(programs.train, depths))


def rendered_depths(
    render: Callable[..., Rendering],
    cameras: Camera,
    scene: Scene,
    *,
    near: float = 0.0,
    depth: Callable[..., jax.Array] = label_depth,
    sizes: Sequence[tuple[int, int]] | None = None,
) -> jax.Array:
    """Render the depths `[V, H, W]` of stacked cameras, for labels and anchors.

    `near` is 0 by default, because close-ups may be nearer to the surface than any photograph.
    Rendering is deterministic; `depth` is that of a `LabelRule`, and `sizes` are those of views
    without padding.
    """
    return render_depths(
        render,
        cameras,
        near=near,
        far=scene.far,
        depth=depth,
        sizes=sizes,
        each=lambda one_view, views: progress.each(one_view, views, "rendering depths"),
    )


def label_target_views(
    programs: Programs,
    start: LabelStart,
    cameras: Camera,
    labels: LabelConfig,
    settings: PseudoSettings,
    get_detail: GetDetail,
) -> Views:
    """Label target views, or other views that are labeled before the first step.

    `settings` are of warps, after the gate. `get_detail` returns the detail of the state that
    fine-tuning begins with, and is called if labels need it.
    """
    if labels.label == "residual":
        detail, _ = get_detail()
        return detailed_views(programs, start.state, detail, cameras)
    render = functools.partial(programs.render, start.state)
    depths = rendered_depths(render, cameras, programs.scene)
    return jax.jit(label_views)(cameras, depths, start.sources, settings)


def label_closeups(
    programs: Programs, start: LabelStart, labels: LabelConfig, keys: RunKeys, get_detail: GetDetail
) -> Views:
    """Label random close-ups with detail, all before the first step: each costs a render."""
    settings = pseudo_settings(labels)
    count = min(programs.preset.closeup_steps, _MOST_CLOSEUPS)
    draw = jax.jit(lambda key: sample_closeups(key, start.sources, settings, count))
    cameras = draw(keys.closeups)
    return label_target_views(programs, start, cameras, labels, settings, get_detail)
