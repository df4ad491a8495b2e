"""Where close-ups look: at what photographs have in their middle."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.share import places
from jaxcloseup.geometry.cameras import Camera


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
        shown=SimpleNamespace(sizes=((40, 40),), extents=extents),
    )
    ahead, aside, behind = [0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [0.0, 0.0, -5.0]
    np.testing.assert_array_equal(
        places._looked_at(detail, np.array([ahead, aside, behind])), [1, 0.5, 0]
    )
