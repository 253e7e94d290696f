"""Who may connect, asked by hand and of a running server; a port in use; viser absent."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.untrusted.guard import bind, guarded_server, is_local, refusal

NEEDS = "viser is not installed (pip install 'viser>=1.1,<1.2')"


@pytest.mark.parametrize(
    ("path", "headers", "token", "why"),
    [
        ("/", {"Host": "localhost:8080"}, None, None),
        ("/", {"Host": "[::1]:8080"}, None, None),
        ("/", {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}, None, None),
        ("/", {"Host": "rebound.example:8080"}, None, "requested as 'rebound.example:8080', expected localhost"),
        ("/", {"Host": "127.0.0.1:8080", "Origin": "http://evil.example"}, None, "another site's page"),
        ("/", {"Host": "host:1"}, "secret", "no token, or a wrong one"),
        ("/?token=secreT", {"Host": "host:1"}, "secret", "no token, or a wrong one"),
        ("/", {"Host": "host:1", "Cookie": "interactive_nav=other"}, "secret", "no token, or a wrong one"),
        ("/", {"Host": "host:1", "Cookie": 'interactive_nav="\\', "Origin": "http://host:1"}, "secret", "no token"),
        ("/?token=secret", {"Host": "host:1"}, "secret", None),
        ("/", {"Host": "host:1", "Cookie": "a=b; interactive_nav=secret", "Origin": "http://host:1"}, "secret", None),
        ("/?token=secret", {"Host": "host:1", "Origin": "http://evil.example"}, "secret", "another site's page"),
    ],
)
def test_who_may_connect(path, headers, token, why):
    found = refusal(path, headers, token)
    assert found is None if why is None else why in (found or "")


def test_addresses_of_this_machine():
    known = (
        "127.0.0.1",
        "::1",
        "localhost",
        "127.9.9.9",
        "0.0.0.0",
        "10.0.0.1",
        "example.org",
        "localhost.example.org",
    )
    assert [is_local(host) for host in known] == [True] * 4 + [False] * 4


def test_nothing_is_sent_before_the_token(capsys):
    viser = pytest.importorskip("viser", reason=NEEDS)
    server, address = guarded_server("0.0.0.0", 0, "room", "view")
    try:
        port, token = server.get_port(), address.partition("?token=")[2]
        page, own = f"http://127.0.0.1:{port}/", [Subprotocol(f"viser-v{viser.__version__}")]
        for wrong in (page, f"{page}?token=x", f"{page}index.html"):
            with pytest.raises(urllib.error.HTTPError, match="403") as refused:
                urllib.request.urlopen(wrong)
            assert refused.value.read().startswith(b"no token, or a wrong one; open the whole address")
        with pytest.raises(InvalidStatus, match="403"):
            connect(page.replace("http", "ws"), subprotocols=own)
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        with opener.open(f"{page}?token={token}") as answer:
            assert answer.url == page and b"<html" in answer.read()
        cookie = {"Cookie": f"interactive_nav={token}"}
        with connect(page.replace("http", "ws"), subprotocols=own, additional_headers=cookie, max_size=None) as socket_:
            assert len(socket_.recv(10)) > 0
    finally:
        server.stop()


def test_a_port_in_use_is_one_line_and_not_another_port():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(
            ConfigError, match=f"127.0.0.1:{port}: cannot be listened on .*in use.*; give another --port"
        ):
            bind("127.0.0.1", port)
    for host, number in (("127.0.0.1", 99_999), ("203.0.113.7", 0), ("no such host", 0)):
        with pytest.raises(ConfigError, match="cannot be listened on"):
            bind(host, number)
