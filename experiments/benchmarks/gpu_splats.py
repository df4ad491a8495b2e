"""Compare and time the compositors of splats on a GPU, also against gsplat."""

import dataclasses
import functools
import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks import splats
from experiments.benchmarks.timing import REPEATS, interleaved_medians
from jaxcloseup.fields.splats import RasterizeConfig


FAIL = 2e-3  # of the largest value, by which two compositors may differ in an image or a derivative
Case = tuple[int, tuple[int, int]]  # number of splats; height and width of the image


def _config(surfels_, camera) -> tuple[RasterizeConfig, int]:
    """Return a configuration with room for all pairs, and their number."""
    config = splats.config_for(surfels_, camera)
    return config, splats.count_pairs(surfels_, camera, config)[0]


def _by(config, compositor: str) -> RasterizeConfig:
    return dataclasses.replace(config, compositor=compositor)


def _compositors() -> tuple[str, ...]:
    # Other devices interpret the kernels, which says nothing about a GPU.
    return ("loops", "kernel") if jax.default_backend() == "gpu" else ("loops",)


@functools.partial(jax.jit, static_argnames="config")
def _pull(surfels_, camera, config):
    """Return images and the derivative of their sum."""
    seen, pullback = jax.vjp(lambda s: splats.render_all(s, camera, config), surfels_)
    return seen, pullback(jax.tree.map(jnp.ones_like, seen))[0]


def correctness(case: Case) -> dict[str, Any]:
    """Compare images and derivatives of each compositor here with loops on the CPU."""
    example = splats.discs_on_a_wall(*case)
    camera, (config, _) = example[1], _config(*example)
    cpu = jax.local_devices(backend="cpu")[0]
    with jax.default_device(cpu):
        on_cpu = jax.device_put(example[0], cpu)
        expected = jax.device_get(_pull(on_cpu, camera, _by(config, "loops")))
    largest = {}
    for compositor in _compositors():
        seen = jax.device_get(_pull(*example, _by(config, compositor)))
        largest[compositor] = max(
            float(np.max(np.abs(a - b)) / max(np.max(np.abs(a)), 1e-6))
            for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(seen), strict=True)
        )
    return {"largest_difference": largest, "agree": max(largest.values()) < FAIL}


def splat_rates(cases: Sequence[Case], known: Mapping[str, float]) -> list[dict[str, Any]]:
    """Time both passes of each compositor in each case; `known` holds the device's rates."""
    rows = []
    for count, image in cases:
        surfels_, camera = splats.discs_on_a_wall(count, image)
        config, pairs = _config(surfels_, camera)
        for compositor in _compositors():
            row = {"splats": count, "image": list(image), "compositor": compositor, "pairs": pairs}
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


def peer(case: Case) -> dict[str, Any]:
    """Time the same splats in gsplat, if it is installed."""
    try:
        import gsplat
        import torch
    except ImportError as error:
        return {"gsplat": f"not installed: {error}"}
    count, (height, width) = case
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
