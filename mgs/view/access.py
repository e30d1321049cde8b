"""Who may use the viewer. Any website can open connections to servers on this machine, so a request
must name this server as host and origin. Elsewhere the first must have the printed token."""

import hmac
import logging
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from mgs.errors import InputError

LOCAL = ("127.0.0.1", "localhost", "::1")  # hosts that only this machine reaches

COOKIE = "mgs_token"


def plain(text: str) -> str:
    """Escape text for Markdown and HTML: every character with a meaning becomes an entity."""
    return "".join(c if c.isalnum() or c in " ,.:;/%" else f"&#{ord(c)};" for c in text)


def bound_socket(host: str, port: int) -> socket.socket:
    """Socket of a server at this host and port; 0: any free port. Raises InputError if no server
    can listen there."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        reason = (error.strerror or str(error)).partition(" (while")[0]
        where = f"host {host} port {port}: cannot be served there ({reason})"
        raise InputError(f"{where}; choose another port or host") from None


class Access:
    """Decides which requests a server answers. host: the address it listens on.

    token: None on an address of this machine alone."""

    def __init__(self, host: str) -> None:
        self.host = host
        self.token = None if host in LOCAL else secrets.token_urlsafe(16)

    def refusal(self, path: str, headers: Any) -> str | None:
        """Why a request is refused; None if it is answered. headers: of websockets."""
        host, origin = headers.get("Host", ""), headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return "the request comes from another website"
        if self.token is None:
            name = urlsplit(f"//{host}").hostname
            return None if name in LOCAL else "the request names another host"
        tokens = parse_qs(urlsplit(path).query).get("token", [])
        cookie = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
        tokens += [cookie.value] if cookie else []
        if any(hmac.compare_digest(text.encode(), self.token.encode()) for text in tokens):
            return None
        return "open the address that mgs view printed, with its token"

    def answered(self, connection: Any, request: Any, answer: Callable[..., Any] | None) -> Any:
        """The response to a request; None goes on to a websocket. answer: of the server."""
        if why := self.refusal(request.path, request.headers):
            return connection.respond(HTTPStatus.FORBIDDEN, f"mgs: {why}\n")
        response = answer(connection, request) if answer else None
        if response is not None and self.token:
            cookie = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            response.headers["Set-Cookie"] = cookie
        return response

    @contextmanager
    def guarding(self, listening: socket.socket) -> Iterator[None]:
        """Context manager in which a server of websockets answers as `answered`, on this socket. By
        itself viser would take the next port that is free, and look for one for ever at a host that
        is not of this machine."""
        from websockets.asyncio import server

        serve, logger = server.serve, logging.getLogger("mgs.view")
        logger.disabled = True

        def guarded(
            handler: Any, host: str, port: int, process_request: Any = None, **options: Any
        ) -> Any:
            options |= {"sock": listening, "logger": logger}
            answer = lambda connection, request: self.answered(connection, request, process_request)  # noqa: E731
            return serve(handler, process_request=answer, **options)

        server.serve = guarded  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            server.serve = serve  # type: ignore[misc]
