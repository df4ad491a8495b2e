"""Draw small random splat scenes, and render them by one function that compiles once."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import reference_splats as reference
from tiny_training import run_train_steps

from jaxcloseup.fields.splats import RasterizeConfig, Surfels, projection, render_surfels
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.training.config import TrainConfig
from jaxcloseup.training.state import init_state


COUNT, HEIGHT, WIDTH, NEAR = 16, 24, 32, 0.2
INTRINSICS = np.array([30.0, 34.0, 14.5, 13.0])  # fx != fy, principal point off the center
IDENTITY = np.eye(4)[:3]
BACKGROUND = np.array([0.2, 0.4, 0.6])
CONFIG = RasterizeConfig(capacity=1024, near=NEAR, tile=8, chunk=4, block=4, compositor="loops")
ANTIALIASED = dataclasses.replace(CONFIG, antialias=True)
KERNEL = dataclasses.replace(CONFIG, compositor="kernel")
NATIVE = dataclasses.replace(CONFIG, compositor="native")
OUTPUTS = ("rgb", "alpha", "depth", "normal", "median_depth", "distortion")


def random_scene(seed, *, depth=(1.0, 3.0), log_scale=(-4.0, -0.7), count=COUNT, num_scales=2):
    """Draw splats in front of the identity pose: float64 arrays by name, exact in float32."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, count)
    xy = rng.uniform(-0.5, 0.5, (count, 2)) * np.maximum(np.abs(z), 0.5)[:, None]
    scene = dict(
        means=np.concatenate([xy, z[:, None]], axis=1),
        log_scales=rng.uniform(*log_scale, (count, num_scales)),
        quaternions=rng.normal(size=(count, 4)),
        opacity_logits=rng.uniform(-2, 4, count),
        sh=0.4 * rng.normal(size=(count, 4, 3)),
    )
    scene["opacity_logits"][0] = 8.0  # beyond the largest alpha
    return {name: value.astype(np.float32).astype(np.float64) for name, value in scene.items()}


SCENES = {
    "in front": random_scene(0),
    "through the camera": random_scene(1, depth=(-0.5, 1.5), log_scale=(-2.0, 0.5)),
    "far and small": random_scene(2, depth=(2.0, 3.0), log_scale=(-6.0, -3.0)),
}
VOLUMES = {
    f"volumes {name}": random_scene(seed, count=8, num_scales=3, **kwargs)
    for name, seed, kwargs in [
        ("in front", 0, dict(log_scale=(-4.0, -1.2))),
        ("through the camera", 1, dict(depth=(-0.5, 1.5), log_scale=(-3.0, -1.0))),
        ("far and small", 2, dict(depth=(2.0, 3.0), log_scale=(-6.0, -3.0))),
    ]
}
SPLATS = SCENES | VOLUMES
CROWDS = {
    **SCENES,
    "long": random_scene(5, count=40, log_scale=(-7.0, -0.5)),
    "faint": random_scene(6, count=40, log_scale=(-5.0, -2.0)),
}
CROWDS["faint"]["opacity_logits"] -= 4.0


def pixel_centers(height=HEIGHT, width=WIDTH):
    """Pixel centers `[H W, 2]` of an image, row by row."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def to_surfels(scene, dtype=jnp.float32):
    return Surfels(**{name: jnp.asarray(value, dtype) for name, value in scene.items()})


def to_camera(camtoworld=IDENTITY, intrinsics=INTRINSICS, size=(HEIGHT, WIDTH), dtype=jnp.float32):
    return Camera(jnp.asarray(camtoworld, dtype), jnp.asarray(intrinsics, dtype), *size)


def render(surfels, camera, alive=None, config=CONFIG):
    """Return all images of `render_surfels` over `BACKGROUND` by name; volumes have no normals."""
    alive = jnp.ones(surfels.means.shape[0], bool) if alive is None else alive
    return _render(surfels, camera, alive, config)


@functools.partial(jax.jit, static_argnames="config")
def _render(surfels, camera, alive, config):
    background = jnp.asarray(BACKGROUND, surfels.means.dtype)
    image = render_surfels(surfels, alive, camera, config, background=background)
    aux = {name: values for name, values in image.aux._asdict().items() if values is not None}
    return dict(rgb=image.rgb, alpha=image.alpha, depth=image.depth, **aux)


def trainer(field, optimizer):
    """Return `start(points)`, a state of gray splats, and `run(state, views, count)`."""
    bound = {"field": field, "optimizer": optimizer}
    config = TrainConfig(num_rays=None, num_label_rays=None)
    compiled = jax.jit(functools.partial(run_train_steps, **bound, config=config))

    def start(points):
        points = jnp.asarray(points, jnp.float32)
        return init_state(jax.random.key(0), points, jnp.full_like(points, 0.5), **bound)

    def run(state, views, count):
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
            return compiled(state, views, count=count)

    return start, run


@functools.partial(jax.jit, static_argnames="antialias")
def footprints_of(surfels, camera, antialias):
    """Project discs with a payload of zeros."""
    discs, _ = projection.to_camera(projection.surfel_columns(surfels), camera)
    opacity = jax.nn.sigmoid(surfels.opacity_logits)
    payload = jnp.zeros((1, len(opacity)), opacity.dtype)
    options = {"near": NEAR, "antialias": antialias}
    return projection.project_discs(discs, opacity, payload, camera, **options)


def drawn(scene, pixels, antialias):
    """Return where the oracle's discs are visible, `[N, ...]`, at `pixels[..., 2]`."""
    options = {"near": NEAR, "antialias": antialias}
    alpha, _ = reference.intersect(scene, IDENTITY, INTRINSICS, pixels.reshape(-1, 2), **options)
    return (alpha > 0).reshape(-1, *pixels.shape[:-1])


def oracle(scene, camtoworld=IDENTITY, intrinsics=INTRINSICS, size=(HEIGHT, WIDTH), **options):
    return reference.render(
        scene, camtoworld, intrinsics, *size, near=NEAR, background=BACKGROUND, **options
    )
