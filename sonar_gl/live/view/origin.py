"""Keeps web sites of others away from the page: a browser lets any site open a WebSocket to this machine."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import contextmanager
from http import HTTPStatus
from urllib.parse import urlsplit

from sonar_gl.core.hosts import is_local

SERVER_LOGGER, NO_REQUEST = "websockets.server", "opening handshake failed"  # of websockets


def is_other_site(origin: str | None, host: str | None, listens_at: str) -> bool:
    """Return whether a request comes from a web site other than the page itself.

    origin : header `Origin`, which browsers send and no script can change; None for programs, which may do all
    host : header `Host`: how the browser named this machine
    listens_at : address that the page listens at

    >>> is_other_site("http://localhost:8080", "localhost:8080", "127.0.0.1")
    False
    >>> is_other_site("https://example.org", "127.0.0.1:8080", "127.0.0.1")
    True
    """
    try:
        name = urlsplit(f"//{host or ''}").hostname
        site = None if origin is None else urlsplit(origin).netloc
    except ValueError:
        return True
    if site is not None and site != host:
        return True
    # a site whose name was made to mean 127.0.0.1 is of its own origin
    return is_local(listens_at) and not is_local(name or "")


@contextmanager
def own_page_alone(listens_at: str):
    """Have servers of viser that are made meanwhile refuse requests of other sites, for which viser has no option.

    Nor do they log a traceback for each browser that connects beforehand, and asks for nothing.
    """
    from websockets.asyncio import server  # of viser, which takes `serve` from this module

    serve, logger = server.serve, logging.Logger(SERVER_LOGGER)
    logger.parent = logging.getLogger(SERVER_LOGGER)
    logger.addFilter(lambda record: record.getMessage() != NO_REQUEST)

    def checked(*values, process_request: Callable | None = None, **options):
        def check(connection, request):
            headers = request.headers
            origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
            if max(len(origins), len(hosts)) > 1 or is_other_site(
                next(iter(origins), None), next(iter(hosts), None), listens_at
            ):
                return connection.respond(HTTPStatus.FORBIDDEN, "only its own page may reach this server\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*values, process_request=check, logger=logger, **options)

    server.serve = checked
    try:
        yield
    finally:
        server.serve = serve
