"""Derivatives of rendered splats, against finite differences of the NumPy splatter."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import reference_splats as reference
from splat_scenes import (
    CONFIG,
    HEIGHT,
    IDENTITY,
    INTRINSICS,
    OUTPUTS,
    SPLATS,
    VOLUMES,
    WIDTH,
    oracle,
    render,
    to_camera,
    to_surfels,
)

from jaxcloseup.geometry.rotations import euler_to_matrix


VECTORS = ("rgb", "normal")


def images_of(values, dtype=jnp.float32):
    """Cotangents of all outputs: `values(shape, output)`."""
    shapes = {name: (HEIGHT, WIDTH, 3) if name in VECTORS else (HEIGHT, WIDTH) for name in OUTPUTS}
    return {name: jnp.asarray(values(shape, name), dtype) for name, shape in shapes.items()}


def pose(twist):
    """Camera-to-world matrix `[3, 4]` from Euler angles and a position `twist[6]`, in NumPy."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(twist[:3]), np.sin(twist[:3])
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.concatenate([z @ y @ x, twist[3:, None]], axis=1)


@functools.partial(jax.jit, static_argnames="config")
def pullback(surfels, twist, intrinsics, cotangents, config=CONFIG):
    def images(surfels, twist, intrinsics):
        camtoworld = jnp.concatenate([euler_to_matrix(twist[:3]), twist[3:, None]], axis=1)
        camera = to_camera().replace(camtoworld=camtoworld, intrinsics=intrinsics)
        out = render(surfels, camera, config=config)
        return {name: out[name] for name in cotangents}

    return jax.vjp(images, surfels, twist, intrinsics)[1](cotangents)


@functools.cache
def jacobian(name, antialias):
    """Central differences of every image of the oracle in every parameter, by parameter name."""
    scene = SPLATS[name]
    at = dict(scene, pose=np.zeros(6), intrinsics=INTRINSICS)
    step = 1e-7
    reach = None if name in VOLUMES else reference.depth_reach(scene, IDENTITY)
    differences = {}
    for name, value in at.items():
        rows = []
        for i in range(value.size):
            images = []
            for sign in (1, -1):
                moved = value.copy()
                moved.flat[i] += sign * step
                moved = {**at, name: moved}
                twist, intrinsics = moved.pop("pose"), moved.pop("intrinsics")
                images.append(
                    oracle(moved, pose(twist), intrinsics, reach=reach, antialias=antialias)
                )
            plus, minus = images
            rows.append({out: (plus[out] - minus[out]) / (2 * step) for out in plus})
        differences[name] = rows
    return scene, differences


def check_derivatives(name, config, precision):
    """Compare the derivatives of each output of `SPLATS[name]` in every parameter."""
    scene, differences = jacobian(name, config.antialias)
    rng = np.random.default_rng(3)
    with jax.enable_x64(True):
        weights = images_of(lambda shape, _: rng.normal(size=shape), "float64")
    weights = jax.tree.map(np.asarray, weights)
    outputs = differences["pose"][0].keys()
    for output in outputs:
        with jax.enable_x64(precision == "float64"):
            cotangents = {
                name: jnp.asarray(weights[name] * (name == output), precision) for name in outputs
            }
            surfels, twist, intrinsics = pullback(
                to_surfels(scene, precision),
                jnp.zeros(6, precision),
                jnp.asarray(INTRINSICS, precision),
                cotangents,
                config,
            )
        computed = {name: getattr(surfels, name) for name in scene}
        computed |= dict(pose=twist, intrinsics=intrinsics)
        for name, rows in differences.items():
            expected = np.array([np.sum(row[output] * weights[output]) for row in rows])
            error = np.abs(np.ravel(computed[name]) - expected).max()
            scale = max(np.abs(expected).max(), 0.1)
            assert error <= (1e-3 if precision == "float32" else 1e-6) * scale, (output, name)
