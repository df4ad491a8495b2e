"""Everything worth knowing about a GPU, in one command; fills `gpu.json` as it goes.

`python -m experiments.bench --suite=gpu` needs no network and about ten minutes. A part that fails
is recorded with its error, and the next one runs. Figures of a CPU are no guide to a GPU's.
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
import numpy as np

import jaxcloseup
from experiments.benchmarks import nerf, splats, sweep
from experiments.benchmarks.timing import interleaved_medians
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
from jaxcloseup.fields.splats import RasterizeConfig
from jaxcloseup.fields.volume.config import NerfConfig


REPEATS = 5
FAIL = 2e-3  # of the largest value, by which two compositors may differ in an image or a derivative


@dataclasses.dataclass(frozen=True)
class Size:
    """How large everything is.

    Attributes:
      cases: numbers of splats, and the heights and widths of their images; smallest first.
      side: of the matrices whose product is a ceiling.
      numbers: that are added and copied; so many that starting a program costs little beside it.
      nerf: the NeRF whose step is timed.
      rays: in such a step.
      scene: name or folder of what is trained on.
      preset: of the surfels that are trained.
      stages: of that training, beside the baseline.
      training_seconds: of their baseline and fine-tuning.
      arms: presets of the sweeps whose steps are timed, by method.
      warmup: steps before these.
      most_seconds: after which no other part begins.
    """

    cases: tuple[tuple[int, tuple[int, int]], ...] = (
        (20_000, (270, 480)),
        (100_000, (540, 960)),
        (500_000, (1080, 1920)),
    )
    side: int = 16_384
    numbers: int = 2**28
    nerf: NerfConfig = nerf.FULL
    rays: int = 4096
    scene: str = "table"
    preset: Preset = surfels.PAPER
    stages: tuple[str, ...] = STAGES
    training_seconds: float = 60
    arms: tuple[Preset, ...] = (surfels.REDUCED, NERF_QUICK)
    warmup: int = 100
    most_seconds: float = 600


def run(size: Size | None = None, path: pathlib.Path | None = None) -> dict[str, Any]:
    """Run all parts; returns what `path` (by default `gpu.json` in this folder) then holds."""
    size, path = size or Size(), path or pathlib.Path("gpu.json")
    parts: dict[str, Callable[[Size], Any]] = {
        "ceilings": ceilings,
        "correctness": correctness,
        "splats": splat_rates,
        "nerf": nerf_rates,
        "training": training,
        "sweep": sweep_rates,
        "peer": peer,
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
    """Versions and devices."""
    return {
        "jaxcloseup": jaxcloseup.__version__,
        "jax": jax.__version__,
        "python": platform.python_version(),
        "backend": jax.default_backend(),
        "devices": [device.device_kind for device in jax.devices()],
    }


def peak_bytes() -> int | None:
    """Most memory of the first device that was in use so far, where it says."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")


def ceilings(size: Size) -> dict[str, float]:
    """Operations and bytes a second: of matrix products, of sums, and of copies."""
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


def _config(surfels_, camera) -> tuple[RasterizeConfig, int]:
    """Room for all pairs, and their number."""
    config = splats.config_for(surfels_, camera)
    return config, splats.count_pairs(surfels_, camera, config)[0]


def _by(config, compositor: str) -> RasterizeConfig:
    return dataclasses.replace(config, compositor=compositor)


def _compositors() -> tuple[str, ...]:
    # Other devices interpret the kernels, which says nothing about a GPU.
    return ("loops", "kernel") if jax.default_backend() == "gpu" else ("loops",)


@functools.partial(jax.jit, static_argnames="config")
def _pull(surfels_, camera, config):
    """Images, and the derivative of their sum."""
    seen, pullback = jax.vjp(lambda s: splats.render_all(s, camera, config), surfels_)
    return seen, pullback(jax.tree.map(jnp.ones_like, seen))[0]


def correctness(size: Size) -> dict[str, Any]:
    """Images and derivatives of each compositor here, against loops on the CPU."""
    example = splats.discs_on_a_wall(*size.cases[0])
    camera, (config, _) = example[1], _config(*example)

    cpu = jax.local_devices(backend="cpu")[0]
    with jax.default_device(cpu):
        on_cpu = jax.device_put(example[0], cpu)
        expected = jax.device_get(_pull(on_cpu, camera, _by(config, "loops")))
    found = {}
    for compositor in _compositors():
        seen = jax.device_get(_pull(*example, _by(config, compositor)))
        found[compositor] = max(
            float(np.max(np.abs(a - b)) / max(np.max(np.abs(a)), 1e-6))
            for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(seen), strict=True)
        )
    return {"largest_difference": found, "agree": all(v < FAIL for v in found.values())}


def splat_rates(size: Size) -> list[dict[str, Any]]:
    """Both passes of each compositor in each case."""
    known, rows = ceilings(size), []
    for count, image in size.cases:
        surfels_, camera = splats.discs_on_a_wall(count, image)
        config, pairs = _config(surfels_, camera)
        for compositor in _compositors():
            row = {
                "splats": count,
                "image": list(image),
                "compositor": compositor,
                "pairs": pairs,
            }
            try:
                row |= _passes(surfels_, camera, _by(config, compositor), pairs, known)
            except Exception as error:  # such as too little memory
                row["error"] = f"{type(error).__name__}: {error}"[:500]
            rows.append(row)
            print(json.dumps(row), flush=True)
    return rows


def _passes(surfels_, camera, config, pairs, known):
    begun = time.perf_counter()
    render = jax.jit(functools.partial(splats.render_all, config=config))
    forward = render.lower(surfels_, camera).compile()
    both = _pull.lower(surfels_, camera, config).compile()
    compiled = time.perf_counter() - begun
    seconds = interleaved_medians(
        {"forward": lambda: forward(surfels_, camera), "both": lambda: both(surfels_, camera)},
        REPEATS,
    )
    evaluations = pairs * config.tile**2
    operations = {"forward": splats.FORWARD_OPERATIONS}
    operations["both"] = splats.FORWARD_OPERATIONS + splats.BACKWARD_OPERATIONS
    # A pair reads its splat's row of 21 numbers; the derivative reads it again and writes as many.
    row_bytes = {"forward": 4 * 21, "both": 12 * 21}
    return {
        "compile_s": compiled,
        "temporary_bytes": both.memory_analysis().temp_size_in_bytes,
        **{f"{name}_ms": 1e3 * value for name, value in seconds.items()},
        **{
            f"{name}_share_of_arithmetic": evaluations
            * operations[name]
            / (value * known["elementwise_float32_per_s"])
            for name, value in seconds.items()
        },
        **{
            f"{name}_share_of_bandwidth": pairs
            * row_bytes[name]
            / (value * known["copied_bytes_per_s"])
            for name, value in seconds.items()
        },
    }


def nerf_rates(size: Size) -> dict[str, Any]:
    """A training step of a NeRF in each precision, as a share of the matrix products' rate."""
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
    """Surfels trained on a scene, all stages, for as many steps as the time allows."""
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
    start = start_labels(programs, outcome.start.state, run_keys(0))
    wanted = jax.tree.map(lambda leaf: leaf[:1], scene.test.cameras)
    begun = time.perf_counter()
    tuned = fine_tune(programs, start, wanted, detail_getter(programs, start.state))
    jax.block_until_ready(programs.render(tuned, jax.tree.map(lambda leaf: leaf[0], wanted)))
    return {
        "image": [scene.train.cameras.height, scene.train.cameras.width],
        "loading_s": loaded,
        "first_step_s": compiled,
        "early_step_ms": 1e3 * step,
        "steps": [preset.baseline_steps, preset.closeup_steps],
        "stages_s": whole.seconds,
        "wanted_view_s": time.perf_counter() - begun,
        "state_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(start.state.params)),
        "room": programs.growth,
        "psnr": {
            stage: {split: scores[split]["psnr"] for split in ("test", "test_far")}
            for stage, scores in outcome.scores.items()
        },
    }


def sweep_rates(size: Size) -> dict[str, Any]:
    """A step of eight arms against eight steps alone."""
    rows = {}
    for preset in size.arms:
        alone, together = sweep.step_seconds(preset, size.scene, warmup=size.warmup)
        rows[preset.method] = {
            "alone_ms": 1e3 * alone,
            "arms_ms": 1e3 * together,
            "over_eight_alone": together / (8 * alone),
        }
    return rows


def peer(size: Size) -> dict[str, Any]:
    """The same splats in gsplat, where it is installed."""
    try:
        import gsplat
        import torch
    except ImportError as error:
        return {"gsplat": f"not installed: {error}"}
    count, (height, width) = size.cases[-1]
    surfels_, camera = splats.discs_on_a_wall(count, (height, width))
    tensor = lambda array: torch.tensor(np.asarray(array), device="cuda")  # noqa: E731
    scales = np.concatenate([np.exp(surfels_.log_scales), np.full((count, 1), 1e-9)], axis=1)
    world = np.concatenate([camera.camtoworld, [[0, 0, 0, 1]]]).astype(np.float32)
    fx, fy, cx, cy = np.asarray(camera.intrinsics)
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)
    rgb = 0.5 + 0.2820948 * np.asarray(surfels_.sh[:, 0])
    given = [
        tensor(value).requires_grad_()
        for value in (
            *(surfels_.means, surfels_.quaternions, scales.astype(np.float32)),
            *(jax.nn.sigmoid(surfels_.opacity_logits), rgb),
        )
    ]
    pose = tensor(np.linalg.inv(world))[None], tensor(intrinsics)[None]

    def both():
        image = gsplat.rasterization_2dgs(*given, *pose, width, height)[0]
        (image**2).mean().backward()
        torch.cuda.synchronize()
        return 0

    seconds = interleaved_medians({"both": both}, REPEATS)["both"]
    return {"gsplat": gsplat.__version__, "splats": count, "both_ms": 1e3 * seconds}
