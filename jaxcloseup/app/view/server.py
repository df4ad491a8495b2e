"""Serve Viser's page at exactly the requested address, and only to pages of that address."""

import contextlib
import http
import io
import ipaddress
import logging
import os
import socket
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from typing import Any
from unittest import mock

import viser
from websockets.asyncio import server as websockets_server


class ServeError(Exception):
    """The server cannot use its address. The message is one sentence that says what to do."""


class Server(viser.ViserServer):
    """Viser's server without its tunnel to a public server, which any page could request."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing, so that no visitor can make the page public."""


def serve(host: str, port: int) -> Server:
    """Start a server at this address.

    Args:
      host: address to serve at.
      port: port to serve at.

    Raises:
      ServeError: the address is in use or is not this computer's.
    """
    check_address(host, port)

    logging.getLogger("websockets").setLevel(logging.WARNING)
    # Viser prints a banner, and takes the next port if this one is in use.
    with contextlib.redirect_stdout(io.StringIO()), _guarded(host):
        server = Server(host=host, port=port, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise ServeError(f"--port={port} is already in use: choose another port")
    server.gui.configure_theme(show_share_button=False, control_width="large")
    return server


def check_address(host: str, port: int) -> None:
    """Check that the address is free, because Viser would silently take another port.

    Raises:
      ServeError: the address is in use or is not this computer's.
    """
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
        raise ServeError(
            f"cannot serve at --host={host} --port={port} ({reason}): choose another port, or an "
            "address of this computer"
        ) from None


@contextlib.contextmanager
def _guarded(host: str) -> Iterator[None]:
    """Make servers that start in this context refuse foreign requests, see `is_foreign`.

    Otherwise, any page that a visitor opens could read the scene through the visitor's browser.
    Viser has no setting for it, and its server runs before its constructor returns.
    """
    serve = websockets_server.serve

    def guarded_serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            if is_foreign(host, hosts, origins):
                text = "This page is served at another address.\n"
                return connection.respond(http.HTTPStatus.FORBIDDEN, text)
            return process_request(connection, request)

        return serve(*args, process_request=process, **options)

    with mock.patch.object(websockets_server, "serve", guarded_serve):
        yield


def is_foreign(served: str, hosts: Sequence[str], origins: Sequence[str]) -> bool:
    """Return whether a request addresses another server, or comes from a page of another one.

    The port may differ from the served one, because a request may come through a tunnel.

    Args:
      served: the address of `--host`.
      hosts: the request's headers `Host`.
      origins: the request's headers `Origin`; a browser sends it with every request to a socket.
    """
    if (
        len(hosts) != 1
        or len(origins) > 1
        or not _means(served, _parts(f"//{hosts[0]}").hostname or "")
    ):
        return True
    return any(_parts(origin).netloc != hosts[0] for origin in origins)


def _parts(address: str) -> urllib.parse.SplitResult:
    """Return the parts of an address, all empty if it is invalid."""
    try:
        return urllib.parse.urlsplit(address)
    except ValueError:
        return urllib.parse.urlsplit("")


def _means(served: str, name: str) -> bool:
    """Return whether the host in a request is the served address."""
    ours, theirs = _ip(served), _ip(name)
    if ours is not None and ours.is_unspecified:
        # Anyone can make a name resolve to this computer, but not a number.
        return theirs is not None or name in ("localhost", socket.gethostname().lower())
    if served == "localhost" or (ours is not None and ours.is_loopback):
        return name == "localhost" or (theirs is not None and theirs.is_loopback)
    return name == served.lower() or (theirs is not None and theirs == ours)


def _ip(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(name)
    return None
