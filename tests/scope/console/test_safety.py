"""300 hostile requests to a console that listens with a token, and to one that listens on this machine alone."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Iterator
from typing import Any

import pytest

from calibration.errors import FileError
from scope.console.folder import SessionFolder
from scope.console.safety import LARGEST_JSON, Guard

TOKEN = "a-token-of-more-than-sixteen-characters"  # noqa: S105
NAMES = frozenset({"192.168.7.20", "cell-3"})
GOOD = [("host", "192.168.7.20:8765"), ("authorization", f"Bearer {TOKEN}")]
PAGES = (
    "/",
    "/scan",
    "/frame.jpg",
    "/files/rig.json",
    "/api/v1/status",
    "/api/v1/scan",
    "/cloud/a",
    "/_nicegui_ws/socket.io/",
)


class Inner:
    """The application behind the guard: records that it was reached."""

    def __init__(self) -> None:
        self.reached = 0
        self.read = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self.reached += 1
        if scope["type"] == "websocket":
            await send({"type": "websocket.accept"})
            return
        while (message := await receive())["type"] == "http.request":
            self.read += len(message.get("body", b""))
            if not message.get("more_body"):
                break
        else:
            return  # the client is gone: nothing is carried out
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"data"})


def call(
    headers: list[tuple[str, str]], path: str = "/", *, method: str = "GET", kind: str = "http", query: str = "", token: str | None = TOKEN,
    body: list[bytes] | None = None,
) -> tuple[int, Inner, bytes]:  # fmt: skip
    """Status of the answer (101 for an accepted socket, 403 for a closed one, 0 for none), the application, and the body."""
    inner, sent = Inner(), []
    chunks = iter(body or [b""])
    last = len(body or [b""])

    async def receive() -> dict[str, Any]:
        nonlocal last
        if kind == "websocket":
            return {"type": "websocket.connect"}
        last -= 1
        return {"type": "http.request", "body": next(chunks, b""), "more_body": last > 0}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {
        "type": kind, "method": method, "path": path, "raw_path": path.encode(), "query_string": query.encode(),
        "headers": [(name.encode(), value.encode("latin-1")) for name, value in headers],
    }  # fmt: skip
    asyncio.run(Guard(inner, NAMES if token else frozenset(), token)(scope, receive, send))
    first = sent[0] if sent else {"type": "none"}
    status = {"http.response.start": first.get("status"), "websocket.accept": 101, "websocket.close": 403}.get(
        first["type"], 0
    )
    return int(status), inner, b"".join(message.get("body", b"") for message in sent)


def hostile() -> Iterator[tuple[str, dict[str, Any]]]:
    """Requests none of which may reach the application, each with what is wrong with it."""
    host = ("host", "192.168.7.20:8765")
    known = ("authorization", f"Bearer {TOKEN}")
    both = (("http", "GET"), ("http", "POST"), ("websocket", "GET"))
    for name in ("evil.example", "evil.example:8765", "192.168.7.20.evil.example", "cell-3.evil.example", "", "cell-3@evil.example",
                 "10.0.0.1", "[::ffff:1.2.3.4]", "cell-3:port"):  # fmt: skip
        for path, (kind, method) in itertools.product(PAGES[:4], both):
            yield f"host {name}", {"headers": [("host", name), known], "path": path, "kind": kind, "method": method}
    yield "two hosts", {"headers": [host, ("host", "evil.example"), known]}
    yield "no host", {"headers": [known]}
    for origin in ("https://evil.example", "http://192.168.7.20", "http://192.168.7.20:8766", "null", "http://192.168.7.20:8765.evil.example",
                   "file://"):  # fmt: skip
        for path, (kind, method) in itertools.product(PAGES[4:], both):
            yield (
                f"origin {origin}",
                {"headers": [host, known, ("origin", origin)], "path": path, "kind": kind, "method": method},
            )
    for site, path in itertools.product(("cross-site", "same-site"), PAGES):
        yield (
            "embedded elsewhere",
            {"headers": [host, known, ("sec-fetch-site", site), ("sec-fetch-mode", "no-cors")], "path": path},
        )
    wrong: list[list[tuple[str, str]]] = [
        [], [("authorization", "Bearer ")], [("authorization", TOKEN)], [("authorization", f"Basic {TOKEN}")],
        [("authorization", f"Bearer {TOKEN[:-1]}")], [("authorization", f"Bearer {TOKEN}x")], [("cookie", "scope_token=")],
        [("cookie", f"scope_tokens={TOKEN}")], [("cookie", f"scope_token={TOKEN.upper()}")], [("cookie", "\xff;=;scope_token")],
    ]  # fmt: skip
    for given, path in itertools.product(wrong, PAGES):
        for kind in ("http", "websocket") if path.startswith("/_") else ("http",):
            yield "no token", {"headers": [host, *given], "path": path, "kind": kind}
    yield "token as a list", {"headers": [host], "query": "token[]=" + TOKEN}
    for path in ("/files/../rig.json", "/files/./rig.json", "/..", "/a/../../etc/passwd", "/files\\..\\rig.json", "/files/\0rig.json",
                 "/" + "a" * 5000):  # fmt: skip
        yield "path", {"headers": [host, known], "path": path}
    for length in ("99999999999", "-1", "1e3", "0x10", str(LARGEST_JSON + 1)):
        yield "length", {"headers": [host, known, ("content-length", length)], "path": "/api/v1/scan", "method": "POST"}
    yield (
        "two lengths",
        {
            "headers": [host, known, ("content-length", "1"), ("content-length", "2")],
            "path": "/api/v1/scan",
            "method": "POST",
        },
    )


ALL = list(hostile())


def test_three_hundred_hostile_requests_reach_nothing() -> None:
    assert len(ALL) >= 300
    for why, request in ALL:
        status, inner, body = call(**request)
        assert inner.reached == 0, (why, request)
        assert status >= 400, (why, request)
        assert TOKEN.encode() not in body
        assert len(body) < 200


def test_the_right_requests_are_answered() -> None:
    assert call(GOOD)[0] == 200
    assert call([("host", "cell-3:8765"), ("cookie", f"scope_token={TOKEN}")])[0] == 200
    assert call([*GOOD, ("origin", "http://192.168.7.20:8765")], "/api/v1/scan", method="POST")[0] == 200
    assert call([*GOOD, ("origin", "http://192.168.7.20:8765")], "/_nicegui_ws/socket.io/", kind="websocket")[0] == 101
    assert call([("host", "localhost:8765")], token=None)[0] == 200
    assert call([("host", "127.0.0.1:8765")], "/api/v1/scan", method="POST", token=None)[0] == 200


def test_a_rebound_name_and_another_page_get_nothing_on_this_machine_either() -> None:
    assert call([("host", "rebound.example:8765")], token=None)[0] == 421
    assert (
        call(
            [("host", "127.0.0.1:8765"), ("origin", "https://evil.example")], "/api/v1/scan", method="POST", token=None
        )[0]
        == 403
    )
    assert (
        call([("host", "127.0.0.1:8765"), ("origin", "https://evil.example")], kind="websocket", token=None)[0] == 403
    )


def test_a_body_without_a_length_is_cut_off() -> None:
    """A body in pieces, none of which tells how many there will be."""
    pieces = [b"x" * 8192] * 20
    status, inner, _ = call(GOOD, "/api/v1/scan", method="POST", body=pieces)
    assert status == 0
    assert inner.read <= LARGEST_JSON


def test_the_token_leaves_the_address_for_a_cookie() -> None:
    status, inner, _ = call([("host", "192.168.7.20:8765")], "//evil.example/", query=f"token={TOKEN}")
    assert (status, inner.reached) == (303, 0)


@pytest.mark.parametrize(
    "name",
    [
        "../rig.json",
        "..",
        ".",
        "",
        "a/../../b",
        "/etc/passwd",
        "a\\b",
        "nul\0",
        "-o",
        ".hidden",
        "<img src=x>",
        "a" * 200,
        "trailing.",
    ],
)
def test_no_name_leads_out_of_the_session_folder(tmp_path, name: str) -> None:
    folder = SessionFolder.open(tmp_path / "session")
    with pytest.raises(FileError):
        folder.inside("scans", name)


def test_a_link_does_not_lead_out_of_it_either(tmp_path) -> None:
    (tmp_path / "secret").write_text("secret")
    folder = SessionFolder.open(tmp_path / "session")
    (folder.root / "scans").mkdir()
    (folder.root / "scans" / "link").symlink_to(tmp_path)
    with pytest.raises(FileError, match="leads out"):
        folder.inside("scans", "link", "secret")
