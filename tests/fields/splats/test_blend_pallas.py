"""The Pallas kernels, interpreted: against the NumPy splatter, and against the loops of jax.lax."""

import functools
import logging
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import pallas
from splat_scenes import (
    CONFIG,
    COUNT,
    KERNEL,
    NEAR,
    OUTPUTS,
    SCENES,
    SPLATS,
    oracle,
    random_scene,
    render,
    to_camera,
    to_surfels,
)

from jaxcloseup.fields.splats import blend_pallas, raster_plan
from jaxcloseup.fields.splats.config import RasterizeConfig, RasterPlan
from jaxcloseup.fields.splats.layout import PAYLOAD
from jaxcloseup.fields.splats.tiling import tile_lists


@pytest.mark.parametrize("name", SPLATS)
def test_images_agree_with_the_oracle(name):
    expected = oracle(SPLATS[name])
    images = render(to_surfels(SPLATS[name]), to_camera(), config=KERNEL)
    assert images["overflow"] == 0
    for output in expected:
        np.testing.assert_allclose(images[output], expected[output], atol=2e-5, rtol=0)


@functools.partial(jax.jit, static_argnames="config")
def pullback(surfels, cotangents, config):
    def images(surfels):
        found = render(surfels, to_camera(), config=config)
        return {name: found[name] for name in cotangents}

    return jax.vjp(images, surfels)[1](cotangents)[0]


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("output", OUTPUTS)
def test_the_derivative_of_each_output_is_that_of_the_loops(name, output):
    surfels = to_surfels(SCENES[name])
    rng = np.random.default_rng(0)
    cotangents = {
        each: jnp.asarray(rng.normal(size=image.shape) * (each == output), jnp.float32)
        for each, image in oracle(SCENES[name]).items()
    }
    expected, found = (pullback(surfels, cotangents, config) for config in (CONFIG, KERNEL))
    for leaf in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
        a, b = np.asarray(getattr(expected, leaf)), np.asarray(getattr(found, leaf))
        np.testing.assert_allclose(b, a, rtol=2e-4, atol=2e-5 * max(np.abs(a).max(), 1e-3))


def test_a_batch_of_images_is_each_image():
    # Their lists are one after another, with room between them.
    scenes = [to_surfels(random_scene(seed)) for seed in (0, 5)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    shapes = {name: oracle(SCENES["in front"])[name].shape for name in OUTPUTS}
    cotangents = {name: jnp.full(shape, 0.5) for name, shape in shapes.items()}
    found = jax.vmap(lambda surfels: pullback(surfels, cotangents, KERNEL))(stacked)
    for i, surfels in enumerate(scenes):
        expected = pullback(surfels, cotangents, KERNEL)
        for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
            assert np.abs(a).max() > 0
            np.testing.assert_allclose(b[i], a, rtol=1e-4, atol=1e-5 * np.abs(a).max())


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated")
def test_kernels_become_programs_of_a_gpu():
    # Triton's part of the compiler needs no GPU; what follows it does.
    count, height, width = COUNT, 16, 16
    box = jnp.tile(jnp.array([[0.0, 0.0, width, height]]), (count, 1))
    lists = tile_lists(box, jnp.ones(count), height=height, width=width, tile=8, capacity=256)
    table = jnp.zeros((count, PAYLOAD + 6))
    plan = RasterPlan(capacity=256, near=NEAR, tile=8)

    def both(table, lists):
        *sums, trace = blend_pallas.forward(plan, table, lists)
        return blend_pallas.backward(plan, table, lists, trace, tuple(sums))

    gpu = jax.sharding.AbstractDevice("NVIDIA H100", num_cores=None, platform="cuda")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=gpu)
    with jax.sharding.use_abstract_mesh(mesh):
        lowered = jax.jit(both).trace(table, lists).lower(lowering_platforms=("cuda",))
    assert lowered.as_text().count("triton") >= 3


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated")
def test_a_gpu_that_cannot_run_them_falls_back_to_loops_and_says_so(caplog):
    raster_plan.kernels_compile.cache_clear()
    # There is no GPU to compile for.
    config = RasterizeConfig(capacity=1024, near=NEAR, chunk=4, block=3, platform="gpu")
    surfels = to_surfels(SCENES["in front"])
    with caplog.at_level(logging.WARNING):
        found = [render(surfels, to_camera(), config=config)["rgb"] for _ in range(2)]
    raster_plan.kernels_compile.cache_clear()
    said = [record.getMessage() for record in caplog.records if "blended" in record.getMessage()]
    assert len(said) == 1 and "\n" not in said[0]
    np.testing.assert_allclose(found[0], oracle(SCENES["in front"])["rgb"], atol=2e-5)


def test_without_their_backend_a_gpu_falls_back_to_loops_and_says_so(caplog, monkeypatch):
    """Pallas' Triton backend is deprecated: where it is gone, nothing else needs it."""
    monkeypatch.delitem(sys.modules, blend_pallas.__name__)
    monkeypatch.delattr(pallas, "triton")
    monkeypatch.setitem(sys.modules, "jax.experimental.pallas.triton", None)
    config = RasterizeConfig(platform="gpu")
    raster_plan.kernels_compile.cache_clear()
    with caplog.at_level(logging.WARNING):
        plans = [raster_plan.plan_raster(config, height=24, width=32) for _ in range(2)]
    raster_plan.kernels_compile.cache_clear()
    assert [plan.compositor for plan in plans] == ["loops"] * 2
    (said,) = (record.getMessage() for record in caplog.records)
    assert "cannot run the kernels" in said and "triton" in said and "\n" not in said


@pytest.mark.parametrize("name", ["compositor", "platform"])
def test_other_names_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be .*, not .*cuda"):
        RasterizeConfig(**{name: "cuda"})
