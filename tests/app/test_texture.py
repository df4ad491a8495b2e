"""A mesh's texture, read between its texels as renderers of glTF do, against the plane's colors."""

import io

import jax.numpy as jnp
import numpy as np
import PIL.Image
import plane
import pytest

from jaxcloseup.app.view import texturing
from jaxcloseup.artifacts.mesh_files import Mesh
from jaxcloseup.detail.add import Detail
from jaxcloseup.photos.depth_maps import gather_sources
from jaxcloseup.photos.pyramids import Pyramid, photograph_pyramid


GRAY = 128


def flat_mesh(count=24, half=1.6):
    """Triangles of the plane z = 0, counterclockwise from above; an odd number of them."""
    side = np.linspace(-half, half, count)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.float32)
    corner = np.arange(count * (count - 1)).reshape(-1, count)[:, :-1].ravel()
    one = np.stack([corner, corner + 1, corner + count], -1)
    other = np.stack([corner + 1, corner + count + 1, corner + count], -1)
    faces = np.concatenate([one, other[:-1]]).astype(np.int32)
    return Mesh(vertices, faces, np.full(vertices.shape, GRAY, np.uint8))


def detail_of(cameras):
    """What photographs of the plane show, with exact depth and without a model."""
    views, depths = plane.make_views(cameras)
    pyramid = photograph_pyramid(views)
    colors = np.asarray(pyramid.values)[:, :3] / 255
    values = np.concatenate([0 * colors, 2 * colors - 1], axis=1)
    shown = Pyramid(
        jnp.asarray(np.rint(127 * values), jnp.int8), pyramid.intrinsics, pyramid.extents
    )
    sources = gather_sources(views.cameras, depths, views.weight)
    return Detail(shown, sources, None, jnp.float32(0), jnp.float32(0))


def read_between(image, places):
    """Colors `[N, 3]` at places `[N, 2]` in [0, 1], interpolated between centers of texels."""
    height, width = image.shape[:2]
    x, y = (places * [width, height] - 0.5).T
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    found = 0
    for i, j in np.ndindex(2, 2):
        share = (1 - abs(x - left - i)) * (1 - abs(y - top - j))
        found = found + share[:, None] * image[top + j, left + i]
    return found


def test_a_surface_has_the_colors_of_its_photographs():
    mesh = flat_mesh()
    cameras = [plane.camera_above(x, 0, 2.0, tilt=tilt) for x, tilt in ((-0.2, 0.1), (0.2, -0.1))]
    textured = texturing.texture_mesh(mesh, texturing.lay_out(mesh, 4096), detail_of(cameras))
    image = np.asarray(PIL.Image.open(io.BytesIO(textured.texture)), np.float64)
    shares = np.random.default_rng(0).dirichlet([0.5] * 3, size=(len(mesh.faces), 3))

    def places(values):
        return np.einsum("fnk,fkc->fnc", shares, values[textured.faces]).reshape(
            -1, values.shape[1]
        )

    points, colors = places(textured.vertices), read_between(image, places(textured.texture_places))
    np.testing.assert_allclose(
        points,
        np.einsum("fnk,fkc->fnc", shares, mesh.vertices[mesh.faces]).reshape(-1, 3),
        atol=1e-6,
    )
    x, y, _ = np.abs(points).T
    shown = (x < 0.7) & (y < 0.5)
    expected = 255 * plane.texture(points[shown])
    apart = np.abs(colors[shown] - expected)
    assert shown.sum() > 300 and apart.mean() < 4 and apart.max() < 30
    unseen = x > 1.45
    assert unseen.sum() > 300 and np.abs(colors[unseen] - GRAY).mean() < 1


def test_triangles_share_no_texels():
    mesh = flat_mesh(5)
    atlas = texturing.lay_out(mesh, 512)._replace(side=12)
    places = texturing.texture_places(atlas).reshape(-1, 3, 2)
    rows = -(-len(atlas.triangles) // atlas.columns)
    texels = places * [atlas.columns * atlas.side, atlas.side * rows]
    owner = np.full((rows * atlas.side, atlas.columns * atlas.side), -1)
    for number, corners in enumerate(texels):
        for share in np.random.default_rng(number).dirichlet([0.3] * 3, size=400):
            x, y = share @ corners - 0.5
            for i, j in np.ndindex(2, 2):  # what is read there
                held = owner[int(y) + j, int(x) + i]
                assert held in (-1, number)
                owner[int(y) + j, int(x) + i] = number
    assert set(np.unique(owner)) == {-1, *range(len(mesh.faces))}


def test_too_many_triangles_are_one_sentence():
    with pytest.raises(texturing.TextureError, match="--texture=64 has no room for 1057 triangles"):
        texturing.lay_out(flat_mesh(), 64)
