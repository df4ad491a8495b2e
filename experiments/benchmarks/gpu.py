"""Measure a GPU in one command; write `gpu.json` after each part.

`python -m experiments.bench --suite=gpu` needs no network and about ten minutes. A part that fails
is recorded with its error, and the next one runs. Figures of a CPU say nothing about a GPU.
"""

import dataclasses
import functools
import json
import pathlib
import platform
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import jaxcloseup
from experiments.benchmarks import gpu_splats, nerf, sweep
from experiments.benchmarks.timing import REPEATS, interleaved_medians
from jaxcloseup.app.methods import surfels
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.nerf import QUICK as NERF_QUICK
from jaxcloseup.app.run.fine_tuning import fine_tune
from jaxcloseup.app.run.kept_detail import detail_getter
from jaxcloseup.app.run.keys import run_keys
from jaxcloseup.app.run.labels import start_labels
from jaxcloseup.app.run.loop import Training
from jaxcloseup.app.run.manifest import identity_of
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.stage_names import STAGES
from jaxcloseup.app.run.stages import run_stages
from jaxcloseup.app.run.states import initial_state
from jaxcloseup.app.run.step_data import TrainData
from jaxcloseup.artifacts.checkpoints import Checkpoints
from jaxcloseup.captures.load import load_scene
from jaxcloseup.fields.volume.config import NerfConfig


@dataclasses.dataclass(frozen=True)
class Size:
    """Sizes of all parts."""

    # numbers of splats, and the heights and widths of their images; smallest first
    cases: tuple[gpu_splats.Case, ...] = (
        (20_000, (270, 480)),
        (100_000, (540, 960)),
        (500_000, (1080, 1920)),
    )
    side: int = 16_384  # of the matrices whose product is a ceiling
    # that are added and copied; so many that starting a program costs little beside it
    numbers: int = 2**28
    nerf: NerfConfig = nerf.FULL  # the NeRF whose step is timed
    rays: int = 4096  # in such a step
    scene: str = "table"  # name or folder of what is trained on
    preset: Preset = surfels.PAPER  # of the surfels that are trained
    stages: tuple[str, ...] = STAGES  # of that training, beside the baseline
    training_seconds: float = 60  # of their baseline and fine-tuning
    # presets of the sweeps whose steps are timed, by method
    arms: tuple[Preset, ...] = (surfels.REDUCED, NERF_QUICK)
    warmup: int = 100  # steps before these
    most_seconds: float = 600  # after which no other part begins


def run(size: Size | None = None, path: pathlib.Path | None = None) -> dict[str, Any]:
    """Run all parts; write their results to `path`, by default `gpu.json`, and return them."""
    size, path = size or Size(), path or pathlib.Path("gpu.json")
    parts: dict[str, Callable[[Size], Any]] = {
        "ceilings": ceilings,
        "correctness": lambda size: gpu_splats.correctness(size.cases[0]),
        "splats": lambda size: gpu_splats.splat_rates(size.cases, ceilings(size)),
        "nerf": nerf_rates,
        "training": training,
        "sweep": sweep_rates,
        "peer": lambda size: gpu_splats.peer(size.cases[-1]),
    }
    start, found = time.perf_counter(), {"about": about()}
    for name, part in parts.items():
        begun = time.perf_counter()
        if begun - start > size.most_seconds:
            found[name] = {"error": f"not begun: {size.most_seconds:.0f} s had passed"}
        else:
            try:
                found[name] = {"found": part(size)}
            except Exception as error:  # the next part may run
                found[name] = {"error": f"{type(error).__name__}: {error}"[:2000]}
        found[name]["seconds"] = time.perf_counter() - begun
        found[name]["peak_bytes"] = peak_bytes()
        path.write_text(json.dumps(found, indent=1))
        print(f"{name}: {json.dumps(found[name])}", flush=True)
    return found


def about() -> dict[str, Any]:
    """Return versions and devices."""
    return {
        "jaxcloseup": jaxcloseup.__version__,
        "jax": jax.__version__,
        "python": platform.python_version(),
        "backend": jax.default_backend(),
        "devices": [device.device_kind for device in jax.devices()],
    }


def peak_bytes() -> int | None:
    """Return the peak memory of the first device so far, or None if unknown."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")


def ceilings(size: Size) -> dict[str, float]:
    """Measure operations and bytes a second of matrix products, of sums and of copies."""
    many, steps = size.numbers, 256
    calls, work = {}, {}
    for dtype in nerf.DTYPES:
        matrix = jnp.ones((size.side, size.side), dtype)
        calls[f"matmul_{dtype}"] = functools.partial(jax.jit(lambda a: a @ a), matrix)
        work[f"matmul_{dtype}"] = 2 * size.side**3
    values = jnp.ones(many)

    @jax.jit
    def add(x):
        for _ in range(steps):
            x = x * 1.0001 + 0.5
        return x

    calls["elementwise_float32"] = functools.partial(add, values)
    work["elementwise_float32"] = 2 * steps * many
    calls["copied_bytes"] = functools.partial(jax.jit(lambda x: x + 1), values)
    work["copied_bytes"] = 8 * many
    seconds = interleaved_medians(calls, REPEATS)
    return {f"{name}_per_s": work[name] / seconds[name] for name in calls}


def nerf_rates(size: Size) -> dict[str, Any]:
    """Time a training step of a NeRF in each precision, as a share of the rate of products."""
    known, rows = ceilings(size), {}
    for dtype in nerf.DTYPES:
        config = dataclasses.replace(size.nerf, compute_dtype=dtype)
        begun = time.perf_counter()
        step, megabytes = nerf.training_step(config, num_rays=size.rays)
        compiled = time.perf_counter() - begun
        seconds = interleaved_medians({"step": step}, REPEATS)["step"]
        rate = size.rays * nerf.training_flops(config) / seconds
        rows[dtype] = {
            "step_ms": 1e3 * seconds,
            "compile_s": compiled,
            "temporary_mb": megabytes,
            "share_of_matmul": rate / known[f"matmul_{dtype}_per_s"],
        }
    return rows


def training(size: Size) -> dict[str, Any]:
    """Train surfels on a scene, all stages, for as many steps as the time allows."""
    preset = size.preset
    begun = time.perf_counter()
    scene = load_scene(size.scene, downscale=preset.downscale)
    scene = dataclasses.replace(scene, train=jax.device_put(scene.train))
    loaded = time.perf_counter() - begun
    programs = Programs(preset, scene)
    state, views = initial_state(programs, run_keys(0)), programs.photographs
    begun = time.perf_counter()
    state, _ = programs.run(state, TrainData(views), count=1)
    compiled = time.perf_counter() - begun
    begun = time.perf_counter()
    programs.run(state, TrainData(views), count=10)
    step = (time.perf_counter() - begun) / 10
    # Surfels multiply, and a step with a label costs more than two without.
    steps = int(size.training_seconds / step / 4)
    preset = dataclasses.replace(
        preset,
        baseline_steps=max(2, min(preset.baseline_steps, steps)),
        closeup_steps=max(1, min(preset.closeup_steps, steps // 8)),
    )
    programs.preset = preset
    with tempfile.TemporaryDirectory() as folder:
        output = pathlib.Path(folder)
        checkpoints = Checkpoints(
            output / "checkpoints", identity_of(scene, preset, {"method": preset.method})
        )
        whole = Training(programs, checkpoints, save_every=10**9)
        outcome = run_stages(whole, 0, output, to_run=size.stages)
    start = start_labels(programs, outcome.start.state)
    target = jax.tree.map(lambda leaf: leaf[:1], scene.test.cameras)
    begun = time.perf_counter()
    tuned = fine_tune(programs, start, target, detail_getter(programs, start.state))
    jax.block_until_ready(programs.render(tuned, jax.tree.map(lambda leaf: leaf[0], target)))
    return {
        "image": [scene.train.cameras.height, scene.train.cameras.width],
        "loading_s": loaded,
        "first_step_s": compiled,
        "early_step_ms": 1e3 * step,
        "steps": [preset.baseline_steps, preset.closeup_steps],
        "stages_s": whole.seconds,
        "target_view_s": time.perf_counter() - begun,
        "state_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(start.state.params)),
        "room": programs.growth,
        "psnr": {
            stage: {split: scores[split]["psnr"] for split in ("test", "test_far")}
            for stage, scores in outcome.scores.items()
        },
    }


def sweep_rates(size: Size) -> dict[str, Any]:
    """Time a step of eight arms against eight steps alone."""
    rows = {}
    for preset in size.arms:
        alone, together = sweep.step_seconds(preset, size.scene, warmup=size.warmup)
        rows[preset.method] = {
            "alone_ms": 1e3 * alone,
            "arms_ms": 1e3 * together,
            "over_eight_alone": together / (8 * alone),
        }
    return rows
