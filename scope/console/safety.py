"""Who may talk to the console: checked before any page, socket or request is looked at (docs/security.md).

Sources: RFC 9110, 7.2 (Host) and 15.5; the Origin header, RFC 6454, 7; Fetch Metadata, W3C (Sec-Fetch-Site).
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

COOKIE = "scope_token"
LARGEST = 64 << 20  # bytes of a body: a mesh that is sent up
LARGEST_JSON = 64 << 10  # bytes of a body for the API
_LONGEST = 4096  # characters of a path with its query
_OWN = {"localhost", "127.0.0.1", "::1"}
_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"SAMEORIGIN"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
)


def new_token() -> str:
    """A token that nobody guesses: 256 bits."""
    return secrets.token_urlsafe(32)


def is_loopback(host: str) -> bool:
    """Whether a host to listen on is this machine alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request is not answered."""

    status: int
    why: str


class Guard:
    """ASGI middleware around everything: Host, Origin, token, path and size.

    Parameters
    ----------
    app : ASGI application
    names : names and addresses under which the console may be called
    token : str or None
        Asked for with every request, where the console listens on more than this machine.
    """

    def __init__(self, app: App, names: frozenset[str], token: str | None) -> None:
        self.app, self._token = app, token
        self._names = names | _OWN

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        if scope["type"] not in {"http", "websocket"}:
            await self.app(scope, receive, send)
            return
        headers = _headers(scope)
        refusal = self._judge(scope, headers)
        if scope["type"] == "websocket":
            if refusal is not None:
                await receive()
                await send({"type": "websocket.close", "code": 1008, "reason": refusal.why})
                return
            await self.app(scope, receive, send)
            return
        if refusal is not None:
            await _refuse(send, refusal)
            return
        if self._token is not None and (cleaned := _without_token(scope)) is not None:
            await _to_cookie(send, cleaned, self._token)
            return
        await self.app(scope, _bounded(receive, _limit(scope)), _hardened(send))

    def _judge(self, scope: Scope, headers: dict[str, list[str]]) -> Refusal | None:
        hosts = headers.get("host", [])
        if len(hosts) != 1 or not self._known(hosts[0]):
            return Refusal(421, "this name is not the console's; call it by the address that it printed")
        origins = headers.get("origin", [])
        if len(origins) > 1 or (origins and urlsplit(origins[0]).netloc.lower() != hosts[0].lower()):
            return Refusal(403, "requests from other pages are refused")
        site = headers.get("sec-fetch-site", ["none"])[-1]
        if site not in {"none", "same-origin"} and (
            headers.get("sec-fetch-mode", [""])[-1] != "navigate" or scope.get("method") != "GET"
        ):
            return Refusal(403, "requests from other pages are refused")
        if self._token is not None and not self._authentic(scope, headers):
            return Refusal(401, "the token is missing or wrong; open the address that `scope console` printed")
        raw = bytes(scope.get("raw_path") or b"") + bytes(scope.get("query_string") or b"")
        path = str(scope.get("path", ""))
        if len(raw) > _LONGEST or "\\" in path or "\0" in path or any(part in {"..", "."} for part in path.split("/")):
            return Refusal(400, "this path is not served")
        lengths = headers.get("content-length", [])
        if lengths and (len(lengths) > 1 or not lengths[0].isdigit() or int(lengths[0]) > _limit(scope)):
            return Refusal(413, f"a body of at most {_limit(scope)} bytes is taken")
        return None

    def _known(self, host: str) -> bool:
        try:
            parts = urlsplit(f"//{host}")
            name, _ = parts.hostname, parts.port
        except ValueError:
            return False
        return name is not None and parts.username is None and not parts.path and name in self._names

    def _authentic(self, scope: Scope, headers: dict[str, list[str]]) -> bool:
        given = [
            value.removeprefix("Bearer ") for value in headers.get("authorization", []) if value.startswith("Bearer ")
        ]
        given += parse_qs(bytes(scope.get("query_string") or b"").decode("latin-1")).get("token", [])
        try:
            for text in headers.get("cookie", []):
                morsel = SimpleCookie(text).get(COOKIE)
                given += [] if morsel is None else [morsel.value]
        except CookieError:
            return False
        wanted = (self._token or "").encode()
        # each is compared in full, in constant time
        right = [hmac.compare_digest(each.encode("utf-8", "replace"), wanted) for each in given[:8]]
        return True in right


def _headers(scope: Scope) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, value in scope.get("headers", []):
        found.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
    return found


def _limit(scope: Scope) -> int:
    return LARGEST_JSON if str(scope.get("path", "")).startswith("/api/") else LARGEST


def _without_token(scope: Scope) -> str | None:
    """Path and query of a page without the token in it; None where there is none, and for the API."""
    query = parse_qs(bytes(scope.get("query_string") or b"").decode("latin-1"), keep_blank_values=True)
    if "token" not in query or scope.get("method") != "GET" or str(scope["path"]).startswith("/api/"):
        return None
    del query["token"]
    path = "/" + str(scope["path"]).lstrip("/")  # never //elsewhere
    return f"{path}?{urlencode(query, doseq=True)}" if query else path


async def _to_cookie(send: Send, place: str, token: str) -> None:
    """Keep the token in a cookie that scripts and other pages never see, and take it out of the address."""
    cookie = f"{COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict"
    headers = [
        (b"location", place.encode("ascii", "replace")),
        (b"set-cookie", cookie.encode()),
        (b"content-length", b"0"),
    ]
    await send({"type": "http.response.start", "status": 303, "headers": [*headers, *_HEADERS]})
    await send({"type": "http.response.body", "body": b""})


async def _refuse(send: Send, refusal: Refusal) -> None:
    body = f"{refusal.why}\n".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode()), *_HEADERS]
    await send(
        {"type": "http.response.start", "status": refusal.status, "headers": [*headers, (b"connection", b"close")]}
    )
    await send({"type": "http.response.body", "body": body})


def _bounded(receive: Receive, limit: int) -> Receive:
    """Receive that ends a body without a length once it grows too large."""
    total = 0

    async def bounded() -> Message:
        nonlocal total
        message = await receive()
        total += len(message.get("body", b""))
        return {"type": "http.disconnect"} if total > limit else message

    return bounded


def _hardened(send: Send) -> Send:
    async def hardened(message: Message) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
        await send(message)

    return hardened
