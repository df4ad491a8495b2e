"""Viser's server at exactly the requested address, or an error that says why not."""

import contextlib
import io
import logging
import os
import socket

import viser


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
    with contextlib.redirect_stdout(io.StringIO()):
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
