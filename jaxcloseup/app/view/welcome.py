"""Give each visitor of the viewer a page of their own."""

from typing import Any

from jaxcloseup.app.view.server import Server
from jaxcloseup.app.view.viewer import Viewer
from jaxcloseup.app.view.visitor import Visitor


def welcome_visitors(server: Server, viewer: Viewer) -> "dict[int, Visitor]":
    """Fill the page of each client that connects to a server; return the present visitors.

    Args:
      server: Viser's server.
      viewer: the run that all of them see.
    """
    visitors: dict[int, Visitor] = {}

    def welcome(client: Any) -> None:
        visitors[client.client_id] = visitor = Visitor(viewer, client)
        if client.client_id not in server.get_clients():  # it left while its page was filled
            visitors.pop(client.client_id, None)
            visitor.leave()

    def forget(client: Any) -> None:
        visitor = visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.leave()

    server.on_client_connect(welcome)
    server.on_client_disconnect(forget)
    return visitors
