"""Put viser's server behind a check of who may connect, on exactly the requested port.

viser 1.1 has neither. It serves pages and websockets through `websockets.asyncio.server.serve`, which asks a function
about every request before it answers; ours comes first, so that nothing is sent, the page itself included, before it
has agreed.
"""

import contextlib
import hmac
import http
import io
import ipaddress
import secrets
import socket
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from interactive_nav_common.errors import ConfigError, missing, optional

COOKIE = "interactive_nav"


def is_local(host: str) -> bool:
    """Return whether an address is reached from this machine alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def refusal(path: str, headers: Any, token: str | None) -> str | None:
    """Return why a request is refused, or None where it is not.

    Without a token the page must have been requested under this machine's name, so that no other site, nor a name
    that leads here, can reach it through the user's browser; and a websocket must be opened by our page.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return "the request comes from another site's page; open this address itself"
    if token is None:
        local = is_local(urlsplit(f"//{host}").hostname or "")
        return None if local else f"the page was requested as '{host}', expected localhost"
    try:
        cookie = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
    except CookieError:
        cookie = None
    given = [cookie.value] if cookie else []
    given += parse_qs(urlsplit(path).query).get("token", [])
    if any(hmac.compare_digest(one.encode(), token.encode()) for one in given):
        return None
    return "no token, or a wrong one; open the whole address that the command printed, ?token= included"


def bind(host: str, port: int) -> socket.socket:
    """Return a listening socket."""
    try:
        if not 0 <= port < 65536:  # the system would take its last 16 bits
            raise OverflowError("no port has this number")
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"{host}:{port}: cannot be listened on ({getattr(error, 'strerror', None) or error}), expected a free port "
            "of this machine; give another --port (0: any) or --host"
        ) from None
    return listening


def guarded_server(host: str, port: int, label: str, user: str) -> tuple[Any, str]:
    """Start viser's server, its page titled `label`; return it and the address to open.

    The address has a token where others can reach it; port 0 is any that is free. `user` is the command, and the extra
    that installs viser for it: annotate or view.
    """
    names = "viser", "websockets.asyncio.server"
    viser, serving = (optional(name, missing(user, "viser", user)) for name in names)
    token, listening = None if is_local(host) else secrets.token_urlsafe(24), bind(host, port)
    original, checked = serving.serve, []

    def serve(handler: Any, _host: str, _port: int, process_request: Any, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            why = refusal(request.path, request.headers, token)
            if why is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{why}\n")
            if token and "token" in parse_qs(urlsplit(request.path).query):  # from here on the cookie says it
                answer = connection.respond(http.HTTPStatus.SEE_OTHER, "")
                answer.headers["Location"] = "/"
                answer.headers["Set-Cookie"] = f"{COOKIE}={token}; HttpOnly; SameSite=Lax; Path=/"
                return answer
            return process_request(connection, request)

        checked.append(True)
        return original(handler, sock=listening, process_request=check, **options)

    setattr(serving, "serve", serve)  # noqa: B010 (viser looks it up when it starts, and takes no other)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # an address without the token
            server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    finally:
        setattr(serving, "serve", original)  # noqa: B010
    if not checked:
        server.stop()
        raise ConfigError(f"viser {viser.__version__} cannot be guarded; pip install 'interactive-nav[{user}]'")
    bound = listening.getsockname()[1]
    shown = f"[{host}]" if ":" in host else host
    return server, f"http://{shown}:{bound}/" + (f"?token={token}" if token else "")
