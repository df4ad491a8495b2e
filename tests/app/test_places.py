"""Where close-ups look: at what photographs have in their middle."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.share import closeups, places
from jaxcloseup.detail.add import Detailed
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.photos.pyramids import Pyramid


def test_the_middle_of_a_photograph_is_that_of_its_own_size():
    """A portrait and a landscape photograph are padded to one size."""
    extents = np.array([[[40, 20]], [[20, 40]]])  # height and width, of one level
    middle = extents[:, 0, ::-1] / 2
    cameras = Camera(
        camtoworld=jnp.stack([jnp.eye(4)[:3]] * 2),
        intrinsics=jnp.asarray(np.concatenate([[[10.0, 10.0]] * 2, middle], axis=1), jnp.float32),
        height=40,
        width=40,
    )
    detail = SimpleNamespace(
        sources=SimpleNamespace(cameras=cameras, trust=np.zeros((2, 40, 40))),
        map_sizes=extents[:, 0],
    )
    ahead, aside, behind = [0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [0.0, 0.0, -5.0]
    np.testing.assert_array_equal(
        places._looked_at(detail, np.array([ahead, aside, behind])), [1, 0.5, 0]
    )


def test_photographs_that_training_read_large_are_searched_too():
    """Their pyramid has no level near the width that is searched elsewhere."""
    height, width, depth = 90, 1000, 5.0
    rng = np.random.default_rng(0)
    rgb = np.zeros((height, width, 3), np.float32)
    rgb[:, :500] = rng.choice([0.2, 0.8], (height, 500, 1))
    camera = Camera(
        camtoworld=jnp.eye(4)[:3],
        intrinsics=jnp.array([800.0, 800.0, width / 2, height / 2]),
        height=height,
        width=width,
    )
    extents = jnp.array([[[height, width]]], jnp.int32)
    values = jnp.asarray(rgb.reshape(-1, 3))
    shown = Pyramid(jnp.concatenate([values, values], -1), camera.intrinsics[None, None], extents)
    everywhere = np.ones((1, height, width), np.float32)
    detail = SimpleNamespace(
        shown=shown,
        sources=SimpleNamespace(
            cameras=jax.tree.map(lambda leaf: leaf[None], camera),
            maps=everywhere,
            trust=everywhere,
            inverse_depth=everywhere / depth,
        ),
        map_sizes=np.array([[height, width]]),
    )
    (place,) = places.best_places(detail, count=1, near=4.0)
    assert place.view == 0 and place.x < 0.5


def test_places_whose_contrast_is_trusted_are_chosen(monkeypatch):
    """Swirls have most contrast, and photographs confirm them least."""
    rng = np.random.default_rng(0)
    kinds = {  # contrast, trust, expected error
        "swirls": (0.30, 0.4, 0.08),
        "sharp": (0.25, 0.8, 0.08),
        "plain": (0.02, 0.9, 0.05),
        "doubtful": (0.25, 0.8, 0.20),
    }
    looks = iter(kinds.values())

    def look(*_):
        contrast, trust, error = next(looks)
        rgb = 0.5 + contrast * rng.choice([-1, 1], (20, 30, 1)).repeat(3, -1)
        return Detailed(rgb, np.full((20, 30), trust), None, np.full((20, 30), error))

    camera = SimpleNamespace(width=30)
    programs = SimpleNamespace(
        scene=SimpleNamespace(own_camera=lambda *_: camera), render=lambda *_: None
    )
    monkeypatch.setattr(closeups, "resized", lambda camera, *_: camera)
    monkeypatch.setattr(closeups, "_look", lambda *_: (camera, None))
    monkeypatch.setattr(closeups, "detailed", look)
    there = [places.Place(view, 0.5, 0.5) for view in range(len(kinds))]
    chosen = closeups.choose_places(programs, None, None, there, near=4, count=3)
    names = [list(kinds)[place.view] for place in chosen]
    assert names == ["sharp", "swirls", "doubtful"]
