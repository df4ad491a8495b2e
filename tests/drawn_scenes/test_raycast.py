"""Ray casting against float64 intersections face by face, and filtered textures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from optimized import optimized

from jaxcloseup.drawn_scenes import raycast, shading
from jaxcloseup.geometry.cameras import Camera, pixel_grid, pixels_to_rays


KINDS = ("plane", "box", "sphere", "cylinder")


def random_rotation(rng):
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return rotation * np.sign(np.linalg.det(rotation))


@pytest.fixture(scope="module")
def clutter():
    """Solids of every kind in a big room, thin and thick, straight and tapered, sorted by kind."""
    rng = np.random.default_rng(0)
    solids = [("box", np.column_stack([4 * np.eye(3), np.zeros(3)]), 0.0)]
    for kind in KINDS:
        for _ in range(6):
            half = rng.choice([0.004, 0.1, 0.5], 3)
            linear = random_rotation(rng) * (half if kind != "plane" else (half[0], half[1], 1))
            taper = rng.uniform(-0.8, 0.8) if kind == "cylinder" else 0.0
            solids.append((kind, np.column_stack([linear, rng.uniform(-2, 2, 3)]), taper))
    return sorted(solids, key=lambda solid: KINDS.index(solid[0]))


def as_solids(solids):
    kind, to_world, taper = zip(*solids, strict=True)
    kind = np.array([KINDS.index(k) for k in kind])
    return raycast.make_solids(kind, np.stack(to_world), np.array(taper), pad_to=32)


def check_against_reference(solids, origins, directions):
    """Compare every ray that does not graze an edge; return how many were compared."""
    hits = raycast.cast_rays(as_solids(solids), origins, directions)
    compared = 0
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        depth, normal, index, margin = reference.first_crossing(solids, origin, direction)
        if margin < 1e-4:
            continue
        compared += 1
        if index < 0:
            assert np.isinf(hits.depth[i])
            continue
        # Single precision is about a micrometer across the surface, and more along a grazing ray.
        tolerance = 2e-6 / abs(normal @ direction)
        np.testing.assert_allclose(hits.depth[i], depth, rtol=1e-6, atol=tolerance)
        np.testing.assert_allclose(hits.normal[i], normal, atol=2e-3)
    return compared


def test_hits_in_a_cluttered_room(clutter):
    rng = np.random.default_rng(1)
    origins = rng.uniform(-3.5, 3.5, (700, 3))
    aims = np.stack([solid[1][:, 3] for solid in clutter])[rng.integers(len(clutter), size=700)]
    directions = aims + rng.normal(0, 0.15, (700, 3)) - origins
    directions *= rng.uniform(0.3, 3, (700, 1)) / np.linalg.norm(directions, axis=-1, keepdims=True)
    assert check_against_reference(clutter, origins, directions) > 450


@pytest.mark.parametrize("kind", KINDS)
def test_each_primitive_from_outside_inside_and_past(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    half = (0.3, 0.5, 1.0 if kind == "plane" else 0.2)
    shape = np.column_stack([random_rotation(rng) * half, [0.1, -0.2, 0.3]])
    solids = [(kind, shape, 0.35 if kind == "cylinder" else 0.0)]
    near, far = rng.normal(0, 0.1, (60, 3)) + shape[:, 3], rng.normal(0, 3, (120, 3))
    origins = np.concatenate([near, far])
    # Rays that miss, rays that hit, and rays nearly parallel to the faces.
    aims = shape[:, 3] + rng.normal(0, 0.25, (180, 3))
    aims[:20] = origins[:20] + rng.normal(size=(20, 2)) @ shape[:, :2].T + 0.003 * shape[:, 2]
    assert check_against_reference(solids, origins, aims - origins) > 120


def test_simple_hits_by_hand():
    rail = np.column_stack([np.diag([0.001, 0.001, 1.0]), [0, 5, 0]])
    solids = as_solids([
        ("plane", np.column_stack([np.eye(3), [0, 0, -1]]), 0.0),
        ("sphere", np.column_stack([0.5 * np.eye(3), [3, 0, 0]]), 0.0),
        ("cylinder", rail, 0.0),
    ])  # fmt: skip
    origins = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0.0015, 0, 0], [0, 0, 5]])
    directions = np.array([[0, 0, -2], [2, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 1, 0], [0, 1, 0]])
    hits = raycast.cast_rays(solids, origins.astype(float), directions.astype(float))
    np.testing.assert_allclose(hits.depth, [1, 1.25, 4.999, np.inf, np.inf, np.inf], rtol=1e-6)
    expected = [[0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(hits.normal, expected, atol=1e-6)


def test_faces_and_charts():
    solids = as_solids([
        ("box", np.column_stack([np.diag([1.0, 2.0, 3.0]), [0, 0, 0]]), 0.0),
        ("cylinder", np.column_stack([np.eye(3), [10, 0, 0]]), 0.5),
    ])  # fmt: skip
    # Rays hit each side of the box, a quarter of its size off the middle, then the cylinder.
    sign, axis = np.tile([-1.0, 1.0], 3), np.repeat(np.arange(3), 2)
    at = 0.5 * np.array([1.0, 2.0, 3.0]) * np.ones((6, 3))
    at[np.arange(6), axis] = 5 * sign
    towards = np.zeros((6, 3))
    towards[np.arange(6), axis] = -sign
    origins = np.concatenate([at, [[10, -9, 0], [10.75, 0, 9], [10.25, 0, -9]]])
    directions = np.concatenate([towards, [[0, 1, 0], [0, 0, -1], [0, 0, 1]]])
    hits = raycast.cast_rays(solids, origins, directions)
    np.testing.assert_array_equal(hits.face, [0, 1, 2, 3, 4, 5, 6, 8, 7])
    np.testing.assert_allclose(hits.chart[:6], 0.75, atol=1e-6)
    # The side's chart starts at -x and goes around via -y; a cap's chart scales with its radius.
    expected = [[0.25, 0.5], [0.5 + 0.75 / 3, 0.5], [0.5 + 0.25, 0.5]]
    np.testing.assert_allclose(hits.chart[6:], expected, atol=1e-5)


def test_solids_must_be_sorted():
    maps = np.stack([np.column_stack([np.eye(3), np.zeros(3)])] * 2)
    with pytest.raises(ValueError, match="sorted by kind"):
        raycast.make_solids(np.array([2, 1]), maps, np.zeros(2))


def test_culling_by_tiles_changes_nothing(clutter):
    solids, rng = as_solids(clutter), np.random.default_rng(3)
    render = optimized(shading.render_geometry)
    for _ in range(3):
        pose = np.column_stack([random_rotation(rng), rng.uniform(-3, 3, 3)])
        camera = Camera(jnp.asarray(pose, jnp.float32), jnp.array([30.0, 31.0, 26.0, 20.0]), 40, 52)
        depth, normal = render(solids, camera)
        hits = raycast.cast_rays(
            solids, *map(np.asarray, pixels_to_rays(camera, pixel_grid(40, 52)))
        )
        np.testing.assert_allclose(depth, hits.depth, rtol=1e-6)
        np.testing.assert_allclose(normal, hits.normal, atol=1e-6)


def test_textures_are_periodic_pyramids_of_means():
    size, rng = shading.TEXTURE_SIZE, np.random.default_rng(5)
    image = rng.integers(0, 256, (size, size, 3)).astype(np.float32) / 255
    texels = jnp.asarray(shading.pack_pyramid(image))[None]
    rows, columns = rng.integers(0, size, (2, 50))
    centers = (np.stack([columns, rows], -1) + 0.5) / size

    @jax.jit
    def sample(uv, level):
        return jax.vmap(lambda uv, level: shading.sample_texture(texels, jnp.int32(0), uv, level))(
            uv.astype(jnp.float32), level
        )

    levels = jnp.zeros(50)
    np.testing.assert_allclose(sample(centers - 3, levels - 1), image[rows, columns], atol=2e-3)
    # Halfway between two texels, also across the border.
    right = image[rows, (columns + 1) % size]
    halfway = sample(centers + np.array([0.5 / size, 1]), levels)
    np.testing.assert_allclose(halfway, (image[rows, columns] + right) / 2, atol=2e-3)
    # Two levels up, texels are means of 4 x 4, rounded twice; between levels, the two blend.
    means = image.reshape(size // 4, 4, size // 4, 4, 3).mean((1, 3))
    coarse = (np.stack([columns // 4, rows // 4], -1) + 0.5) / (size // 4)
    at_two = sample(coarse, levels + 2)
    np.testing.assert_allclose(at_two, means[rows // 4, columns // 4], atol=6e-3)
    between = sample(coarse, levels + 1.25)
    np.testing.assert_allclose(
        between, 0.75 * sample(coarse, levels + 1) + 0.25 * at_two, atol=1e-5
    )
    np.testing.assert_allclose(sample(centers, levels + 99), np.full((50, 3), 0.5), atol=0.01)
