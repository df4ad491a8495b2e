"""What the viewer's window shows while its visitor moves, without a browser."""

import contextlib
import threading
import time
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.geometry.cameras import Camera


@pytest.fixture
def visitor():
    """A visitor, and what the window was told to show, in order."""
    module = pytest.importorskip("jaxcloseup.app.view.visitor", reason="needs viser")
    pose, lens = np.eye(3, 4, dtype=np.float32), np.array([60, 60, 32, 24], np.float32)
    like = Camera(jnp.asarray(pose), jnp.asarray(lens), 48, 64)
    shown, movers = [], []

    class Scene:
        def set_background_image(self, picture, **_):
            if picture is not None:  # viser encodes it before anything is sent
                movers.append(threading.Thread(target=move))
                movers[-1].start()
                time.sleep(0.1)
            shown.append("scene" if picture is None else "picture")

    def move():
        place.position = place.position + np.array([0.1, 0, 0])
        found._on_move(None)

    place = SimpleNamespace(wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3), fov=1.0)
    place.image_width, place.image_height = 64, 48
    found = module.Visitor.__new__(module.Visitor)
    found._client = SimpleNamespace(camera=place, scene=Scene(), atomic=contextlib.nullcontext)
    found._viewer = SimpleNamespace(
        distance=1.0,
        scene=SimpleNamespace(camera=lambda *_: like),
        background=lambda: None,
        look=lambda *_, **__: (np.zeros((48, 64, 3), np.uint8), None),
    )
    found._prepared = found._rendered = found._rest = None
    found._size, found._gone, found._drawn = (0, 0), True, SimpleNamespace(visible=True)
    found._drawing, found._showing = threading.Lock(), threading.Lock()
    found._automatic = found._sharpen = SimpleNamespace(value=False)
    found._shown, found._legend = SimpleNamespace(value="picture"), SimpleNamespace(visible=False)
    yield found, shown, movers
    found.leave()


def test_a_picture_that_is_finished_during_a_drag_does_not_stay(visitor):
    """The move comes while the picture is encoded, which is before it is sent."""
    visitor, shown, movers = visitor
    visitor._show(None, visitor._own_camera())
    for mover in movers:
        mover.join(timeout=10)
    assert shown == ["picture", "scene"]
    assert visitor._drawn.visible and visitor._rendered is None
