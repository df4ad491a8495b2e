"""The viewer: its page in a browser, if one is installed, and one sentence for each mistake."""

import contextlib
import http.client
import queue
import socket
import sys
import types
import unittest.mock

import jax
import numpy as np
import pytest
from absl import flags
from absl.testing import flagsaver
from browser import click_in_the_middle, free_port, open_browser, press, wait
from reference_splats import sh_color
from tiny_runs import TINY

from jaxcloseup.app.cli import view as program
from jaxcloseup.app.run.loop import TrainingError
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.store.stored_run import load_run_scene, read_run, restore
from jaxcloseup.artifacts.images import color_counts, to_uint8


HAS = "return document.body.innerText.includes(arguments[0])"
# Returns the pixels of the picture, of its support and of its expected error, once the picture
# differs from the argument.
PICTURES = """
const shown = [...document.images].filter(image => image.complete && image.naturalWidth > 300);
const pixels = shown.map(image => {
    const canvas = document.createElement('canvas');
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    canvas.getContext('2d').drawImage(image, 0, 0);
    return canvas.toDataURL();
});
return pixels.length == 3 && pixels[0] != arguments[0] ? pixels : null;
"""

# Whether the picture is seen at the top of the panel, which pressing a button has scrolled.
IN_VIEW = """
const [picture] = [...document.images].filter(image => image.naturalWidth > 300);
for (let one = picture; one; one = one.parentElement) one.scrollTop = 0;
const box = picture.getBoundingClientRect();
return box.top >= 0 && box.bottom <= innerHeight;
"""


@pytest.fixture
def viser():
    return pytest.importorskip("viser", reason='needs viser (the extra "viewer")')


@pytest.fixture
def serve(viser):
    """Return a function that serves a state at a free port; it returns the page and its address."""
    from jaxcloseup.app.view.server import serve
    from jaxcloseup.app.view.viewer import Viewer
    from jaxcloseup.app.view.visitor import welcome_visitors

    servers = []

    def call(programs, state):
        port = free_port()
        servers.append(serve("127.0.0.1", port))
        page = Viewer(servers[0], programs, state, stage="closeup", seed=0)
        call.visitors = welcome_visitors(servers[0], page)
        return page, f"http://127.0.0.1:{port}"

    with jax.numpy_dtype_promotion("standard"):
        yield call
    for server in servers:
        server.stop()


def test_a_closeup_is_chosen_and_rendered_in_a_browser(serve, kept, monkeypatch):
    told = []

    def darker(programs, start, cameras, find, *, report):
        state = start.state
        report(3, 10)
        told.extend(visitor._status.content for visitor in serve.visitors.values())
        assert start.sources.depths.shape == programs.scene.train.weight.shape
        assert cameras.intrinsics.shape == (1, 4)
        return state.replace(params=state.params.replace(sh=state.params.sh - 1))

    monkeypatch.setattr("jaxcloseup.app.view.viewer.fine_tune", darker)
    with open_browser() as browser:
        record = read_run(kept)
        programs, state = restore(record, load_run_scene(record), "closeup")
        page, address = serve(programs, state)
        browser.get(address)
        wait(browser, HAS, "Render")
        press(browser, "Download PNG")
        wait(browser, HAS, "There is no picture yet")
        click_in_the_middle(browser)
        page.work(timeout=30)
        wait(browser, HAS, "photographs show that point")
        pictures = [[None]]
        for button in ("Render", "Fine-tune and render", "Render"):
            press(browser, button)
            page.work(timeout=30)
            said = "Fine-tuned and rendered (" if "tune" in button else "Rendered ("
            wait(browser, HAS, said)
            pictures.append(wait(browser, PICTURES, pictures[-1][0]))
        browser.set_window_size(900, 700)
        wait(browser, IN_VIEW)
    assert told == ["fine-tuning for this camera: 3 of 10 steps ..."]
    _, rendered, tuned, again = pictures
    assert tuned[1] == rendered[1]  # darker, but with the same support
    assert again == rendered  # every fine-tuning starts from the same state, which does not change


def visit(page):
    """A visitor without a browser: its client, which only keeps what it is told."""
    from jaxcloseup.app.view.visitor import Visitor

    client = unittest.mock.MagicMock()
    client.gui.add_image.side_effect = lambda image, *, visible, **_: types.SimpleNamespace(
        image=image, visible=visible
    )
    client.gui.add_checkbox.side_effect = lambda _, initial_value: types.SimpleNamespace(
        value=initial_value, on_update=lambda call: call
    )
    return Visitor(page, client), client


def test_each_visitor_has_a_camera_a_picture_and_colors_of_their_own(serve, kept, monkeypatch):
    record = read_run(kept)
    programs, state = restore(record, load_run_scene(record), "closeup")
    sh = state.params.sh.at[:, 1:].set(jax.random.normal(jax.random.key(0), (3,)))
    state = state.replace(params=state.params.replace(sh=sh))
    page, _ = serve(programs, state)
    (one, client), (other, second) = visit(page), visit(page)
    second.camera.position = second.camera.position + np.array([0.4, 0.2, 0.0])
    client.camera.fov = second.camera.fov = 0.8
    one._sharpen.value = other._sharpen.value = False
    one._on_render(None, tuned=False)
    page.work(timeout=1)
    assert one._image.visible and not other._image.visible
    other._on_render(None, tuned=False)
    page.work(timeout=1)
    assert np.abs(one._picture - np.float32(other._picture)).mean() > 1
    for visitor in (one, other):
        expected = programs.render(state, visitor._own_camera()).rgb
        np.testing.assert_array_equal(visitor._picture, to_uint8(expected))

    surfels, alive = state.params, np.asarray(state.buffers.alive)
    drawn = []
    for visitor in (one, other):
        visitor._on_move(None)
        visitor._rest.join(timeout=10)
        position = visitor._client.camera.position
        colors = [
            sh_color(terms, (mean - position) / np.linalg.norm(mean - position))
            for mean, terms in zip(
                *(np.asarray(a)[alive] for a in (surfels.means, sh)), strict=True
            )
        ]
        drawn.append(visitor._drawn.rgbs)
        np.testing.assert_allclose(drawn[-1], np.clip(colors, 0, 1), atol=1e-4)
    assert np.abs(drawn[0] - drawn[1]).max() > 0.02

    one._supported.value = True
    one._on_support()
    page.work(timeout=1)
    assert one._legend.visible and not other._legend.visible
    # All five photographs see the middle of the plane: a color of the map, tinted.
    middle = np.abs(np.asarray(surfels.means)[alive]).max(axis=1) < 0.3
    assert (page.counts[middle] == 5).all()
    tint = color_counts(page.counts)[0]
    expected = 0.7 * tint + 0.3 * 255 * drawn[0]
    np.testing.assert_allclose(one._drawn.rgbs, expected, atol=1)
    np.testing.assert_array_equal(other._drawn.rgbs, drawn[1])
    one._supported.value = False
    one._on_support()
    np.testing.assert_array_equal(one._drawn.rgbs, drawn[0])
    # A render that is asked for while a click's camera is sought shows that camera.
    find, ray = page.find_surface, programs.scene.camera("train", 0)

    def press_meanwhile(*at):
        one._on_render(None, tuned=False)
        return find(*at)

    monkeypatch.setattr(page, "find_surface", press_meanwhile)
    one._nearer.value, one._visited = 2.0, -np.inf
    at = {"ray_origin": ray.position, "ray_direction": ray.rotation[:, 2]}
    one._on_click(types.SimpleNamespace(**at))
    for _ in range(2):
        page.work(timeout=1)
    expected = programs.render(state, one._camera).rgb
    np.testing.assert_array_equal(one._picture, to_uint8(expected))
    one.leave()
    one._drawn.rgbs = None
    one._draw()
    assert one._drawn.rgbs is None


def test_the_page_shows_the_points_of_a_nerf(serve, kept):
    programs = Programs(TINY, load_run_scene(read_run(kept)))
    page, _ = serve(programs, types.SimpleNamespace(params={}))
    with pytest.raises(queue.Empty):
        page.work(timeout=0)
    visitor, client = visit(page)
    visitor._draw()
    drawn = client.scene.add_point_cloud.called
    assert drawn == bool(len(programs.scene.points)) and not client.scene.add_gaussian_splats.called


def test_the_page_shows_failures_and_stays_up(serve, kept, capsys):
    page, _ = serve(
        Programs(TINY, load_run_scene(read_run(kept))), types.SimpleNamespace(params={})
    )

    def fail(error):
        raise error

    said = []
    page.later("trying", lambda: fail(TrainingError("the loss was not finite")), said.append)
    page.later("trying more", lambda: "done", said.append)
    assert "still busy" in said[-1]
    page.work()
    assert said[-1] == "the loss was not finite"
    page.later("trying", lambda: fail(ValueError("a bug")), said.append)
    page.work()
    assert said[-1] == "trying failed (ValueError): see the terminal for details."
    assert "ValueError: a bug" in capsys.readouterr().err


def test_the_page_never_becomes_public(viser):
    from jaxcloseup.app.view.server import serve

    server = serve("127.0.0.1", free_port())
    assert server.request_share_url() is None
    assert server._share_tunnel is None
    server.stop()


def test_pages_of_other_servers_are_refused(viser):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    from jaxcloseup.app.view.server import serve

    port = free_port()
    server = serve("127.0.0.1", port)

    def status(host):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        with contextlib.closing(connection):
            connection.request("GET", "/", headers={"Host": host})
            with connection.getresponse() as answer:
                return answer.status

    def opens(origin, host=f"127.0.0.1:{port}"):
        # The request goes to the server's address, whatever name it gives it.
        try:
            with (
                socket.create_connection(("127.0.0.1", port)) as link,
                connect(f"ws://{host}", sock=link, origin=origin, subprotocols=["viser-v0"]),
            ):
                return True
        except InvalidStatus as error:
            assert error.response.status_code == 403
            return False

    try:
        for host in (f"127.0.0.1:{port}", f"localhost:{port}", "localhost:8000", "[::1]:8000"):
            assert status(host) == 200
            assert opens(f"http://{host}", host)
        assert opens(None)
        for host in ("evil.example", f"evil.example:{port}", "localhost.evil.example", "[::", ""):
            assert status(host) == 403
        for origin in (
            "http://evil.example",
            f"http://evil.example:{port}",
            "http://127.0.0.1:8000",
            f"http://127.0.0.1:{port}.evil.example",
            "null",
        ):
            assert not opens(origin)
        assert not opens(f"http://evil.example:{port}", f"evil.example:{port}")
    finally:
        server.stop()


@pytest.mark.parametrize(
    ("served", "host", "foreign"),
    [
        ("0.0.0.0", "192.168.1.5:7007", False),
        ("0.0.0.0", "localhost:7007", False),
        ("0.0.0.0", "evil.example:7007", True),
        ("::", "[fe80::1]:7007", False),
        ("192.168.1.5", "192.168.1.5:7007", False),
        ("192.168.1.5", "192.168.1.6:7007", True),
        ("192.168.1.5", "localhost:7007", True),
        ("Studio.local", "studio.local:7007", False),
        ("localhost", "127.0.0.1:7007", False),
        ("127.0.0.1", "127.0.0.2:7007", False),
        ("127.0.0.1", "192.168.1.5:7007", True),
    ],
)
def test_the_address_of_a_request_is_the_served_one(viser, served, host, foreign):
    from jaxcloseup.app.view.server import is_foreign

    assert is_foreign(served, [host], []) == foreign
    assert is_foreign(served, [host, host], [])
    assert is_foreign(served, [host], ["http://elsewhere.example"])


@pytest.fixture
def run(kept):
    flags.FLAGS(["view"])

    def call(**given):
        with flagsaver.flagsaver(compilation_cache="", **{"run": str(kept), **given}):
            program.main(["view"])

    return call


def test_a_mistake_exits_with_one_sentence(run, viser):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SystemExit, match=rf"--port={port} \(Address already in use\)"):
            run(port=port)
    with pytest.raises(SystemExit, match=r"--host=10\.255\.255\.1 .*an address of this computer"):
        run(host="10.255.255.1", port=free_port())
    with pytest.raises(SystemExit, match=r"jaxcloseup view: --run=nowhere is not a folder"):
        run(run="nowhere")


def test_an_error_without_viser_names_the_extra(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in ("jaxcloseup.app.view.server", "jaxcloseup.app.view.viewer"):
        monkeypatch.delitem(sys.modules, name, raising=False)
        monkeypatch.delattr(name, raising=False)
    with pytest.raises(SystemExit, match='install jaxcloseup with the extra "viewer"'):
        run()
