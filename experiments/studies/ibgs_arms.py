"""Two differences of IBGS as arms: a spatial head of the scene's own, and joint training.

    python -m experiments.studies.ibgs_arms --runs=outputs/studies/default/table

IBGS (Nguyen et al., "IBGS: Image-Based Gaussian Splatting", NeurIPS 2025, arXiv 2511.14357) adds a
residual that a small convolutional network of each scene predicts from the photographs' colors, and
trains the field and the network together. Here detail is gathered after training, pixel by pixel,
with networks from other scenes. Two arms change one of these each, in runs of drawn scenes:

- *head*: three layers of 3 x 3 convolutions over the same features correct the known networks'
  outputs and add colors. They learn from the scene's own photographs, each rendered with what the
  others show.
- *joint*: the field's last steps learn what detail leaves over: each photograph minus what the
  others add to its render. Its control takes as many steps on the photographs themselves.
"""

import functools
import pathlib
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from absl import flags
from flax import linen as nn

from experiments.studies.tables import CLOSEUPS, ORDINARY, format_gain, print_table
from experiments.studies.trained_run import TrainedRun, open_run
from jaxcloseup.app.cli.start import loading, set_up_compilation_cache, start
from jaxcloseup.app.run.kept_detail import detailed, make_detail
from jaxcloseup.app.run.labels import start_labels
from jaxcloseup.app.run.scoring import hold_out
from jaxcloseup.app.run.step_data import TrainData
from jaxcloseup.app.score.scores import evaluate
from jaxcloseup.app.score.targets import Target
from jaxcloseup.detail.add import Detail, find_candidates, leave_out
from jaxcloseup.detail.weights import mean_output, mix
from jaxcloseup.fields.contract import Rendering
from jaxcloseup.geometry.cameras import Camera, pixel_grid
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.pyramids import photograph_pyramid
from jaxcloseup.photos.views import Photograph, camera_at, to_float, unpadded
from jaxcloseup.photos.windows import Windows, photograph_windows
from jaxcloseup.training.state import TrainState


FLAGS = flags.FLAGS
_CROP, _BATCH, _MARGIN = 96, 4, 3  # pixels of a crop, crops of a step, pixels that see its border
_WIDTH = 24  # channels of the head's hidden layers

Render = Callable[[Camera], Rendering]


class Head(nn.Module):
    """Three layers of 3 x 3 convolutions, whose outputs are 0 before training."""

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Return changes of two logits, and colors to add, `[..., H, W, 5]`."""
        for _ in range(2):
            inputs = nn.relu(nn.Conv(_WIDTH, (3, 3))(inputs))
        return nn.Conv(5, (3, 3), kernel_init=nn.initializers.zeros)(inputs)


class Gathered(NamedTuple):
    """What the head reads and what it changes, of a view `[H, W]`; `[N, H, W]` of crops."""

    features: Any  # `[..., F]` standardized
    outputs: Any  # `[..., 2]` of the known networks
    residual: Any  # `[..., 3]`
    colors: Any  # `[..., 3]`
    seen: Any  # `[...]` whether any photograph saw the surface


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("runs", None, "folders of runs of drawn scenes, as `experiments.run` makes")
    flags.DEFINE_string("stage", "baseline", "stage whose state is taken")
    flags.DEFINE_integer("head_steps", 1500, "steps that train the head", lower_bound=0)
    flags.DEFINE_integer("photographs", 20, "photographs that teach the head", lower_bound=1)
    flags.DEFINE_integer("rounds", 2, "times that residuals are taken anew", lower_bound=1)
    flags.DEFINE_integer("joint_steps", 250, "steps of each of these rounds", lower_bound=0)
    flags.mark_flag_as_required("runs")


def main(_: list[str]) -> None:
    """Train and score the arms of every run, and print a table of each."""
    with loading():
        set_up_compilation_cache(None)
    for folder in map(pathlib.Path, FLAGS.runs):
        print_arms(open_run(folder, FLAGS.stage))


def print_arms(run: TrainedRun) -> None:
    """Train and score both arms of a run, and print them beside detail as it is."""
    programs, detail = run.programs, run.detail()
    held_out = hold_out(programs, start_labels(programs, run.state), ladder=False)
    score = functools.partial(score_views, held_out.targets)
    scores = {"field": score(functools.partial(programs.render, run.state))}
    scores["detail"] = score(with_detail(run, run.state, detail))
    if FLAGS.head_steps:
        count = len(run.scene.names["train"])
        chosen = np.linspace(0, count - 1, min(FLAGS.photographs, count)).astype(int)
        examples = [example(run, detail, view) for view in chosen.tolist()]
        head = train_head(examples, FLAGS.head_steps)
        scores["detail, head"] = score(with_head(run, detail, head))
    if FLAGS.joint_steps:
        for title, joint in (("detail, more steps", False), ("detail, joint", True)):
            state = train_on(run, detail, joint=joint)
            scores[title] = score(with_detail(run, state, make_detail(programs, state)[0]))
    over = {"detail, head": "detail", "detail, joint": "detail, more steps"}
    rows = []
    for title, found in scores.items():
        row = [title]
        for split in (CLOSEUPS, ORDINARY):
            row += [f"{found[split][name]:.{digits}f}" for name, digits in _SHOWN.items()]
            row.append(_gain(found, scores[over[title]], split) if title in over else "-")
        rows.append(row)
    shown = ["PSNR", "color-corrected", "SSIM", "resolves (px)", "gain, color-corrected (95 %)"]
    header = [f"{kind}: {name}" for kind in ("close-ups", "ordinary views") for name in shown]
    print_table(f"{run.scene.name}, differences of IBGS", ["arm", *header], rows)


_SHOWN = {"psnr": 2, "cc_psnr": 2, "ssim": 3, "resolves": 1}


def _gain(found: Any, others: Any, split: str) -> str:
    views, before = found[split]["views"], others[split]["views"]
    return format_gain([views[name]["cc_psnr"] - before[name]["cc_psnr"] for name in views])


def score_views(targets: dict[str, Sequence[Target]], render: Render) -> dict[str, Any]:
    """Return the scores of the close-ups and the ordinary views at their own size."""
    return {
        split: evaluate(lambda camera, _=None: render(camera), targets[split])[0]
        for split in (CLOSEUPS, ORDINARY)
    }


def with_detail(run: TrainedRun, state: TrainState, detail: Detail) -> Render:
    """Return a function that renders a state with detail as runs do."""

    def render(camera: Camera) -> Rendering:
        seen = run.programs.render(state, camera)
        return seen._replace(rgb=detailed(run.programs, detail, camera, seen).rgb)

    return render


def gather(run: TrainedRun, detail: Detail, camera: Camera, seen: Rendering) -> Gathered:
    """Gather what a head reads at the surface of a render."""
    pixels, depth = pixel_grid(camera.height, camera.width), label_depth(seen, far=run.scene.far)
    found = find_candidates(detail, camera, pixels, seen.rgb, seen.alpha, depth)
    networks = detail.weights.mixing
    features = (found.features - networks.center.mean(0)) * networks.scale.mean(0)
    outputs = jax.jit(mean_output)(networks, found.features)
    return Gathered(features, outputs, found.residual, found.colors, found.weight > 0)


@jax.jit
def add_by_head(params: Any, gathered: Gathered) -> jax.Array:
    """Return what detail adds to a render `[..., H, W, 3]`, corrected by a head."""
    inputs = (jnp.clip(gathered.features, -3, 3), gathered.outputs)
    inputs += (8 * gathered.residual, 8 * gathered.colors, gathered.seen[..., None])
    stacked = jnp.concatenate([part.astype(jnp.float32) for part in inputs], axis=-1)
    change: Any = Head().apply(params, stacked)
    outputs, residual, colors = (
        part.astype(jnp.float32) for part in (gathered.outputs, gathered.residual, gathered.colors)
    )
    mixed, share = mix(outputs + change[..., :2], residual, colors)
    added = share[..., None] * mixed + change[..., 2:] / 8
    return jnp.where(gathered.seen[..., None], added, 0)


def with_head(run: TrainedRun, detail: Detail, params: Any) -> Render:
    """Return a function that renders with detail as a head corrects it."""

    def render(camera: Camera) -> Rendering:
        seen = run.programs.render(run.state, camera)
        gathered = gather(run, detail, camera, seen)
        added = add_by_head(params, gathered)
        visible = gathered.seen[..., None]
        count = jnp.maximum(jnp.sum(visible), 1).astype(jnp.float32)
        # As `add_detail` does: detail keeps the mean color of the view.
        added -= jnp.where(visible, jnp.sum(added, (0, 1)) / count, 0)
        sharper = jnp.clip(jnp.clip(seen.rgb, 0, 1) + added, 0, 1)
        filled = detailed(run.programs, detail, camera, seen).rgb
        return seen._replace(rgb=jnp.where(visible, sharper, filled))

    return render


def train_head(examples: Sequence[tuple[Gathered, np.ndarray]], steps: int) -> Any:
    """Train a head on what views gather and on what their renders miss, `[H, W, 3]`."""
    rng, (first, _) = np.random.default_rng(0), examples[0]
    channels = sum(part.shape[-1] for part in first[:4]) + 1
    params = Head().init(jax.random.key(0), jnp.zeros((1, 8, 8, channels)))
    optimizer = optax.adam(optax.cosine_decay_schedule(2e-3, steps))
    state = optimizer.init(params)

    @jax.jit
    def step(params: Any, state: Any, crops: Gathered, missing: Any) -> tuple[Any, Any, Any]:
        def loss(params: Any) -> jax.Array:
            off = jnp.abs(add_by_head(params, crops) - missing.astype(jnp.float32))
            inner = slice(_MARGIN, -_MARGIN)
            counts = crops.seen[:, inner, inner, None].astype(jnp.float32)
            return jnp.sum(counts * off[:, inner, inner]) / jnp.maximum(3 * jnp.sum(counts), 1)

        value, gradient = jax.value_and_grad(loss)(params)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies by counts of steps
            update, after = optimizer.update(gradient, state)
        return optax.apply_updates(params, update), after, value

    losses = []
    for index in range(steps):
        crops = [crop(examples[rng.integers(len(examples))], rng) for _ in range(_BATCH)]
        stacked = jax.tree.map(lambda *arrays: np.stack(arrays), *crops)
        params, state, value = step(params, state, *stacked)
        losses.append(float(value))
        if (index + 1) % 250 == 0:
            print(f"head, step {index + 1}: {np.mean(losses[-250:]):.5f}", flush=True)
    return params


def example(run: TrainedRun, detail: Detail, view: int) -> tuple[Gathered, np.ndarray]:
    """Return what the other photographs show of a photograph, and what its render misses."""
    camera, photograph = photograph_at(run, view)
    seen = run.programs.render(run.state, camera)
    gathered = gather(run, leave_out(detail, view), camera, seen)
    missing = photograph - jnp.clip(seen.rgb, 0, 1)
    halves = [np.asarray(part, np.float16) for part in gathered[:4]]
    return Gathered(*halves, np.asarray(gathered.seen)), np.asarray(missing, np.float16)


def photograph_at(run: TrainedRun, view: int) -> tuple[Camera, jax.Array]:
    """Return camera and colors of a training photograph at its own size."""
    pyramid, _ = run.programs.pyramid()
    camera = pyramid.camera(camera_at(run.scene.train.cameras, view), view, 0)
    return camera, to_float(pyramid.image(view, 0))[..., :3]


def crop(whole: tuple[Gathered, np.ndarray], rng: np.random.Generator) -> Any:
    """Cut a square at random out of a view."""
    height, width = whole[1].shape[:2]
    y, x = (int(rng.integers(size - _CROP + 1)) for size in (height, width))
    return jax.tree.map(lambda array: array[y : y + _CROP, x : x + _CROP], whole)


def train_on(run: TrainedRun, detail: Detail, *, joint: bool) -> TrainState:
    """Train a state on, in rounds, jointly with what detail adds or on photographs alone."""
    programs, state = run.programs, run.state
    for index in range(FLAGS.rounds):
        if joint and index:
            detail, _ = make_detail(programs, state)
        data = left_over(run, state, detail) if joint else programs.photographs
        state, _ = programs.run(state, TrainData(data), count=FLAGS.joint_steps)
    return state


def left_over(run: TrainedRun, state: TrainState, detail: Detail) -> Windows:
    """Return windows of the photographs minus what the others add to their renders."""
    programs, scene = run.programs, run.scene
    found = []
    for view in range(len(scene.names["train"])):
        camera, photograph = photograph_at(run, view)
        seen = programs.render(state, camera)
        sharper = detailed(programs, leave_out(detail, view), camera, seen).rgb
        rest = jnp.clip(photograph - (sharper - jnp.clip(seen.rgb, 0, 1)), 0, 1)
        weight = np.ones(rest.shape[:2], np.float32)
        found.append(Photograph(camera, np.asarray(rest), weight))
    pyramid = photograph_pyramid(found, unpadded(scene.train, scene.sizes("train")))
    windows = programs.preset.windows
    assert windows is not None, "the run learned from whole photographs"
    return photograph_windows(scene.train.cameras, pyramid, whole_share=windows.whole_share)


if __name__ == "__main__":
    define_flags()
    start(sys.modules[__name__])
