"""The viewer's server: its page is for the address that was asked for, and for nobody else."""

import contextlib
import http.client
import socket

import pytest
from browser import free_port


pytest.importorskip("viser", reason='needs viser (the extra "viewer")')


def test_the_page_never_becomes_public():
    from jaxcloseup.app.view.server import serve

    server = serve("127.0.0.1", free_port())
    assert server.request_share_url() is None
    assert server._share_tunnel is None
    server.stop()


def test_pages_of_other_servers_are_refused():
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
            "http://[",
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
def test_the_address_of_a_request_is_the_served_one(served, host, foreign):
    from jaxcloseup.app.view.server import is_foreign

    assert is_foreign(served, [host], []) == foreign
    assert is_foreign(served, [host, host], [])
    assert is_foreign(served, [host], ["http://elsewhere.example"])
    assert is_foreign(served, [host], ["http://["])
