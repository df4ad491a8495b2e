"""Viser's server at one address: it is there and nowhere else, or a sentence says why not."""

import contextlib
import io
import logging
import os
import socket

import viser


class ServeError(Exception):
    """Nothing can be served. The message is one sentence that says what to do."""


class Server(viser.ViserServer):
    """Viser's, without its tunnel to a public server, which any page could ask for."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Not done."""


def serve(host: str, port: int) -> Server:
    """A server that can be reached at this address only.

    Raises:
      ServeError: the address cannot be had.
    """
    check_address(host, port)

    logging.getLogger("websockets").setLevel(logging.WARNING)
    # Viser has a banner of its own, and takes the next port where one is in use.
    with contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=host, port=port, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise ServeError(f"--port={port} was taken just now: choose another")
    server.gui.configure_theme(show_share_button=False, control_width="large")
    return server


def check_address(host: str, port: int) -> None:
    """Complain where no server can be: Viser would take another port without a word.

    Raises:
      ServeError: the address cannot be had.
    """
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
        raise ServeError(
            f"--host={host} --port={port} cannot be served at ({reason}): choose another port, or "
            "an address of this computer"
        ) from None
