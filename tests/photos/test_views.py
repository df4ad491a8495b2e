import jax
import jax.numpy as jnp
import numpy as np
import plane

from jaxcloseup.photos.views import sample_image, sample_pixels, to_float


def make_views():
    views, _ = plane.make_views([plane.camera_above(x, 0, 4.0) for x in (-1.0, 0.0, 1.0)])
    return views.replace(weight=views.weight.at[1, 3:].set(0))


def test_drawn_pixels_have_the_color_weight_and_camera_of_their_place(key):
    views = make_views()
    batch = jax.jit(sample_pixels, static_argnames="count")(key, views, count=500)
    column, row = np.asarray(batch.pixels).T
    view = np.asarray(batch.cameras.position)[:, 0] + 1
    assert set(view) == {0, 1, 2}
    index = view.astype(int), (row - 0.5).astype(int), (column - 0.5).astype(int)
    assert np.all(column % 1 == 0.5)
    np.testing.assert_array_equal(batch.rgb, np.asarray(views.rgb)[index])
    np.testing.assert_array_equal(batch.weight, np.asarray(views.weight)[index])
    assert column.max() > plane.WIDTH - 2
    assert row.max() > plane.HEIGHT - 2


def test_a_drawn_photograph_is_one_of_the_views(key):
    views = make_views()
    batch = sample_image(key, views)
    view = int(batch.cameras.position[0]) + 1
    assert batch.pixels is None
    np.testing.assert_array_equal(batch.rgb, views.rgb[view])


def test_bytes_become_floats_and_floats_stay():
    levels = jnp.array([0, 51, 255], jnp.uint8)
    np.testing.assert_allclose(to_float(levels), [0, 0.2, 1], rtol=1e-6)
    np.testing.assert_array_equal(to_float(jnp.array([0.3])), jnp.array([0.3]))
