"""Boxes and homographies of discs against rays that meet them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_splats as reference
from splat_scenes import IDENTITY, NEAR, pixel_centers, random_scene, to_surfels
from splat_scenes import to_camera as make_camera

from jaxcloseup.fields.splats.config import RasterizeConfig
from jaxcloseup.fields.splats.projection import project_discs, surfel_columns, to_camera


SIZE, INTRINSICS = (48, 64), np.array([50.0, 56.0, 29.5, 27.0])
DISCS = 500


@functools.partial(jax.jit, static_argnums=2)
def project(surfels, camera, antialias=False):
    discs, normals = to_camera(surfel_columns(surfels), camera)
    opacity = jax.nn.sigmoid(surfels.opacity_logits)
    options = {"near": NEAR, "antialias": antialias}
    found = project_discs(discs, opacity, jnp.stack(normals), camera, **options)
    homography = jnp.moveaxis(found.homography, -1, 0)
    return found.box.T, found.opacity, found.anchor.T, homography, found.low_pass


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(depth=(-0.5, 1.5), log_scale=(-4.0, 0.0)),
        dict(depth=(0.2, 0.6), log_scale=(-3.0, -0.5)),
        dict(depth=(1.0, 5.0), log_scale=(-6.0, -1.0)),
    ],
    ids=["through the camera", "near", "in front"],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_no_visible_pixel_is_outside_its_box(kwargs, seed):
    scene = random_scene(seed, count=DISCS, **kwargs)
    pixels = pixel_centers(*SIZE)
    alpha, _ = reference.intersect(scene, IDENTITY, INTRINSICS, pixels, near=NEAR)
    box, opacity, *_ = project(to_surfels(scene), make_camera(intrinsics=INTRINSICS, size=SIZE))
    box = np.asarray(box, np.float64)[:, None]
    inside = np.all((pixels >= box[..., :2]) & (pixels <= box[..., 2:]), axis=-1)
    assert (alpha > 0).any(1).sum() > DISCS // 10
    assert np.all(inside[alpha > 0])
    assert np.all(opacity[(alpha > 0).any(1)] > 0)


def test_boxes_are_tight_around_the_rim():
    scene = random_scene(4, depth=(0.3, 4.0), log_scale=(-5.0, -1.5), count=DISCS)
    reach = reference.depth_reach(scene, IDENTITY)
    box, *_ = project(to_surfels(scene), make_camera(intrinsics=INTRINSICS, size=SIZE))
    theta = np.linspace(0, 2 * np.pi, 2000)[:, None]
    cutoff = np.sqrt(2 * np.log(255 / (1 + np.exp(-scene["opacity_logits"]))))
    checked = 0
    for i in np.flatnonzero(scene["means"][:, 2] - reach > NEAR):
        tangent_u, tangent_v, _ = reference.rotation_of(scene["quaternions"][i]).T
        scale = cutoff[i] * np.exp(scene["log_scales"][i])
        offset = scale[0] * np.cos(theta) * tangent_u + scale[1] * np.sin(theta) * tangent_v
        rim = scene["means"][i] + offset
        rim = rim[:, :2] / rim[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
        center = scene["means"][i, :2] / scene["means"][i, 2] * INTRINSICS[:2] + INTRINSICS[2:]
        floor = cutoff[i] / np.sqrt(2)
        low = np.minimum(rim.min(0), center - floor)
        high = np.maximum(rim.max(0), center + floor)
        slack = 0.05 + 0.01 * (high - low)
        assert np.all(low - box[i, :2] < slack) and np.all(box[i, 2:] - high < slack)
        assert np.all(box[i, :2] <= low) and np.all(box[i, 2:] >= high)
        checked += 1
    assert checked > DISCS // 2


def test_homographies_agree_with_rays():
    """u, v and z from the homography equal those of the intersection, wherever the anchor lies."""
    scene = random_scene(3, depth=(-1.0, 2.0), log_scale=(-1.0, 1.0), count=DISCS)
    camera = make_camera(intrinsics=INTRINSICS, size=SIZE)
    _, opacity, anchor, rows, _ = map(np.asarray, project(to_surfels(scene), camera))
    pixel = np.array([40.3, 11.7])
    d = np.concatenate([np.ones((DISCS, 1)), pixel - anchor.astype(np.float64)], axis=1)
    u, v, inverse = np.einsum("nij,nj->in", rows.astype(np.float64), d)
    ray = np.array([*((pixel - INTRINSICS[2:]) / INTRINSICS[:2]), 1])
    checked = 0
    for i in np.flatnonzero(opacity > 0):
        tangent_u, tangent_v, normal = reference.rotation_of(scene["quaternions"][i]).T
        z = normal @ scene["means"][i] / (normal @ ray)
        if abs(normal @ ray) > 0.1 and abs(z) < 20:
            offset = (z * ray - scene["means"][i]) / np.exp(scene["log_scales"][i])[:, None]
            actual = [1 / inverse[i], u[i] / inverse[i], v[i] / inverse[i]]
            expected = [z, offset[0] @ tangent_u, offset[1] @ tangent_v]
            np.testing.assert_allclose(actual, expected, rtol=2e-4, atol=2e-4)
            checked += 1
    assert checked > 100


def test_the_low_pass_of_discs_behind_the_camera_is_out_of_sight():
    """An anchor at a pixel's center would draw them in the middle of images with odd sides."""
    size = 47, 63
    scene = random_scene(5, depth=(-1.0, -0.5), log_scale=(0.0, 1.0), count=DISCS)
    camera = make_camera(intrinsics=INTRINSICS, size=size)
    _, opacity, anchor, _, low_pass = map(np.asarray, project(to_surfels(scene), camera))
    pixels = pixel_centers(*size)
    rho = low_pass * np.sum((pixels[:, None] - anchor) ** 2, axis=-1).min(axis=0)
    assert np.sum(opacity > 0) > DISCS // 10 and np.all(rho > 100)


@pytest.mark.parametrize("log_scale", [(-6.0, -3.0), (-4.0, -0.5)], ids=["small", "large"])
def test_antialiased_discs_are_convolved_with_the_pixel(log_scale):
    scene = random_scene(6, depth=(1.0, 3.0), log_scale=log_scale, count=DISCS)
    pixels = pixel_centers(*SIZE)
    expected, _ = reference.intersect(
        scene, IDENTITY, INTRINSICS, pixels, near=NEAR, antialias=True
    )
    camera = make_camera(intrinsics=INTRINSICS, size=SIZE)
    box, opacity, anchor, rows, low_pass = map(
        lambda leaf: np.asarray(leaf, np.float64), project(to_surfels(scene), camera, True)
    )
    offset = pixels[None] - anchor[:, None]
    d = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=-1)
    u, v, inverse = np.einsum("nij,npj->inp", rows, d)
    with np.errstate(divide="ignore", over="ignore"):
        rho = np.where(inverse > 0, (u * u + v * v) / inverse**2, np.inf)
    actual = np.minimum(opacity[:, None] * np.exp(-rho / 2), reference.ALPHA_MAX)
    seen = expected > 1.01 * reference.ALPHA_MIN
    assert seen.any(1).sum() > DISCS // 10 and np.all(low_pass >= 1e9)
    np.testing.assert_allclose(actual[seen], expected[seen], rtol=2e-3)
    inside = np.all((pixels >= box[:, None, :2]) & (pixels <= box[:, None, 2:]), axis=-1)
    assert np.all(inside[seen])


def test_near_must_be_positive():
    discs, _ = to_camera(surfel_columns(to_surfels(random_scene(0))), make_camera())
    with pytest.raises(ValueError, match="near must be a positive depth"):
        project_discs(discs, np.ones(16), np.ones((3, 16)), make_camera(), near=0.0)
    with pytest.raises(ValueError, match="near must be a positive depth"):
        RasterizeConfig(near=-1.0)
