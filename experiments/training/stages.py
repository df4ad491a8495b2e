"""All stages of one experiment on one scene, from photographs to the report."""

import contextlib
import dataclasses
import functools
import math
import pathlib
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcloseup
from experiments.evaluation.audit import audit_labels, left_out_curve
from experiments.evaluation.ladder import ladder_in_short, ladder_targets
from experiments.evaluation.scores import (
    NO_PERCEPTUAL,
    Perceptual,
    evaluate,
    exact_depths,
    targets_by_split,
)
from experiments.methods.presets import Preset, initial_points, pseudo_settings, test_time_steps
from experiments.reporting.pictures import comparisons, label_pictures, write_renders, write_truth
from experiments.reporting.report import in_short, write_json, write_report
from experiments.training.gate import print_gate, weigh_labels
from experiments.training.logs import TrainLog
from experiments.training.loop import Programs, run_stage
from experiments.training.manifest import (
    about_scene,
    hash_data,
    hash_wanted,
    write_dataparser_transforms,
    write_manifest,
)
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.artifacts.surfel_ply import write_surfels
from jaxcloseup.field import Rendering
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.geometry.union_warp import block_sources
from jaxcloseup.photographs import camera_at
from jaxcloseup.pseudo import label_views
from jaxcloseup.scenes import Scene
from jaxcloseup.splats import Surfels
from jaxcloseup.train import TrainState, init_state, label_depth


STAGES = ("baseline", "control", "closeup", "test_time")


def run(
    scene: Scene,
    preset: Preset,
    seed: int,
    output_dir: pathlib.Path,
    *,
    names: dict[str, str],
    to_run: Sequence[str] = STAGES,
    save_every: int = 1000,
    perceptual: Perceptual = NO_PERCEPTUAL,
    load_options: Mapping[str, Any] | None = None,
    tensorboard: bool = False,
) -> dict[str, Any]:
    """The stages on one scene; writes everything under `output_dir` and returns the results.

    Args:
      scene: what is photographed.
      preset: how it is trained.
      seed: random seed.
      output_dir: an empty folder, or that of the same run, cut off.
      names: of "method" and "preset", for the report.
      to_run: stages; `baseline` always runs.
      save_every: steps between checkpoints. Those in `output_dir` are gone on from.
      perceptual: networks of LPIPS.
      load_options: what `load_scene` was given, to load the scene again; for the manifest.
      tensorboard: whether to write event files, beside `stats/train.jsonl`.
    """
    _, key_audit, key_pictures = jax.random.split(jax.random.key(seed), 3)
    scene = dataclasses.replace(scene, train=jax.device_put(scene.train))
    views, size = scene.train, scene.train.cameras
    print(
        f"{scene.name}: {len(views)} training photographs of {size.width} x {size.height}, "
        f"depth {scene.near:.3g} to {scene.far:.3g}"
    )
    programs = Programs(preset, scene)
    identity = {"scene": scene.name, "seed": seed, "config": config(preset), **names}
    identity |= {"resolution": [size.width, size.height], "version": jaxcloseup.__version__}
    identity |= {"data_sha256": hash_data(scene), "wanted_sha256": hash_wanted(scene)}
    checkpoints = Checkpoints(output_dir / "checkpoints", identity)
    log = TrainLog(output_dir, tensorboard=tensorboard)
    settings = pseudo_settings(preset)
    seconds: dict[str, float] = {}
    history, stages, renderings = {}, {}, {}
    load_options = {"downscale": preset.downscale} if load_options is None else load_options
    manifest = {**names, "seed": seed, "config": config(preset), "versions": versions()}
    manifest |= about_scene(scene, load_options)
    write_manifest(output_dir, manifest)
    write_dataparser_transforms(output_dir, scene)

    def train(stage, kind, state, *data, steps):
        with timed(seconds, stage):
            state, history[stage] = run_stage(
                stage,
                programs,
                kind,
                state,
                *data,
                steps=steps,
                checkpoints=checkpoints,
                save_every=save_every,
                log=log,
            )
        return state

    def score(stage, state):
        with timed(seconds, f"{stage}_evaluation"):
            stages[stage], shown = {}, {}
            for split, of_split in held_out.items():
                rendered = functools.partial(programs.render, state)
                stages[stage][split], seen = evaluate(rendered, of_split, perceptual)
                write_renders(output_dir / "renders" / stage / split, seen, scene)
                if split in targets:
                    renderings[stage, split] = seen
                    name, first = next(iter(seen.items()))
                    shown[f"{split}/{name}"] = first.rgb
                    print(f"{stage:>9} {split}: {in_short(stages[stage][split])}", flush=True)
            log.evaluated(stage, stages[stage], shown)
            if len(held_out) > len(targets):
                print(f"{stage:>9} {ladder_in_short(stages[stage])}", flush=True)
            if isinstance(state.params, Surfels):
                path = output_dir / "splats" / f"{stage}.ply"
                write_surfels(path, state.params, state.buffers.alive)

    say_what_is_left_out(programs)
    state = state_to_begin(programs, seed)
    baseline = train("baseline", "photographs", state, views, steps=preset.baseline_steps)
    render = functools.partial(programs.render, baseline)
    with timed(seconds, "depths"):
        depths = training_depths(programs, baseline, seed)
        sources = jax.jit(block_sources)(views.cameras, depths, views.weight)
        exact = exact_depths(scene, views.cameras) if scene.surface else None
        targets = targets_by_split(scene, depths, exact, render)
        held_out = targets | ({} if exact is None else ladder_targets(scene, exact))
    write_truth(output_dir / "renders" / "truth", held_out)
    score("baseline", baseline)
    gate = None
    if preset.gated:
        with timed(seconds, "gate"):
            settings, gate = weigh_labels(views, depths, render, settings)
            print_gate(gate)
    use_labels = gate is None or gate["weight"] > 0
    controls: dict[int, TrainState] = {}

    def control_of(steps, name):
        if steps not in controls:
            controls[steps] = train(name, "photographs", baseline, views, steps=steps)
            score(name, controls[steps])
        return controls[steps]

    def fine_tune(stage, control, kind, *data, steps):
        without = None
        if "control" in to_run or not use_labels:
            without = control_of(steps, control)
        # Without labels a stage is its control: the same steps on the same photographs.
        state = train(stage, kind, baseline, *data, steps=steps) if use_labels else without
        score(stage, state)

    if "control" in to_run:
        control_of(preset.closeup_steps, "control")
    if "closeup" in to_run:
        data = views, depths, settings, sources
        fine_tune("closeup", "control", "virtual", *data, steps=preset.closeup_steps)
    if "test_time" in to_run and scene.test is None:
        print(f"no test_time: no close-ups of {scene.name} are held out (--split=closest does)")
    elif "test_time" in to_run:
        with timed(seconds, "test_time_labels"):
            cameras = scene.test.cameras
            seen = rendered_depths(render, cameras, scene, near=0.0)
            data = cameras, seen, views, depths, settings
            labels = jax.jit(label_views)(*data, sources=sources)
        steps = test_time_steps(preset, len(scene.test))
        data = views, labels, settings
        fine_tune("test_time", "test_time_control", "targets", *data, steps=steps)

    with timed(seconds, "report"):
        of_labels = {
            "scene": scene,
            "settings": settings,
            "depths": depths,
            "render_depth": lambda camera: label_depth(render(camera)),
        }
        pictures = comparisons(output_dir / "compare", targets, renderings)
        shown = targets.get("test", [])
        pictures += label_pictures(key_pictures, shown, output_dir / "labels", **of_labels)
        audit = {}
        if exact is not None:
            truth = {
                "depths": exact,
                "render_depth": jax.jit(lambda camera: scene.surface(camera).depth),
            }
            audit["exact_depth"] = audit_labels(key_audit, exact, **of_labels | truth)
            audit["trained_depth"] = audit_labels(key_audit, exact, **of_labels)
        left_out = left_out_curve(views, depths, render, settings)
    results = {
        "scene": scene.name,
        **names,
        "seed": seed,
        "resolution": [size.width, size.height],
        "stages": stages,
        "labels": audit,
        "left_out": left_out,
        "gate": gate,
        "seconds": seconds,
        "history": history,
        "config": config(preset),
        "versions": versions(),
    }
    write_json(output_dir / "results.json", results)
    write_report(output_dir / "report.html", results, pictures)
    write_manifest(output_dir, manifest, seconds)
    return results


def state_to_begin(programs: Programs, seed: int) -> TrainState:
    """What a seed's baseline is trained from, in a run and in a sweep."""
    key_init, _, _ = jax.random.split(jax.random.key(seed), 3)
    points = initial_points(jax.random.fold_in(key_init, 2), programs.scene)
    return init_state(key_init, *points, field=programs.field, optimizer=programs.optimizer)


def say_what_is_left_out(programs: Programs) -> None:
    """Print how many points surfels begin with, where there is room for some alone."""
    most, count = getattr(programs.preset.field, "capacity", math.inf), len(programs.scene.points)
    if count > most:
        print(f"{most} of {count} points are begun with: --capacity makes room for more")


def training_depths(programs: Programs, state: TrainState, seed: int) -> jax.Array:
    """Depths `[V, H, W]` of the training views as the preset makes labels with, of a seed's run."""
    train, scene = programs.preset.train, programs.scene
    key_init, _, _ = jax.random.split(jax.random.key(seed), 3)
    return rendered_depths(
        functools.partial(programs.render, state),
        scene.train.cameras,
        scene,
        key=jax.random.fold_in(key_init, 1) if train.perturbed_depth else None,
        divided=not train.undivided_depth,
    )


def rendered_depths(
    render: Callable[..., Rendering],
    cameras: Camera,
    scene: Scene,
    *,
    near: float | None = None,
    key: jax.Array | None = None,
    divided: bool = True,
) -> jax.Array:
    """`render_depths` of stacked cameras, by a `render` that makes room where images need it.

    `near` is the scene's by default; close-ups may be nearer to the surface than any photograph.
    """
    count = cameras.intrinsics.shape[0]
    keys = [None] * count if key is None else jax.random.split(key, count)
    seen = (render(camera_at(cameras, i), keys[i]) for i in range(count))
    limits = {"near": scene.near if near is None else near, "far": scene.far, "divided": divided}
    return jnp.stack([label_depth(one, **limits) for one in seen])


@contextlib.contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Record under `name` how long the body takes."""
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start


def config(preset: Preset) -> dict[str, Any]:
    """The configuration as JSON can hold it: what is infinite, and so off, becomes "inf"."""

    def plain(value):
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, tuple):
            return list(value)
        return "inf" if value == np.inf else value

    return plain(dataclasses.asdict(preset))


def versions() -> dict[str, str]:
    """What made the numbers."""
    return {
        "jaxcloseup": jaxcloseup.__version__,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
    }
