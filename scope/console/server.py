"""The console as an HTTP server: pages, pictures and API behind one guard."""

from __future__ import annotations

import socket
import threading
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from calibration.errors import FileError
from scope.console.console import Console
from scope.console.safety import Guard, is_loopback, new_token
from scope.errors import MissingLibraryError
from scope.version import __version__


@dataclass(frozen=True, slots=True)
class Address:
    """Where the console listens."""

    host: str = "127.0.0.1"
    port: int = 8765
    token: str | None = None  # None: none is asked for, which only this machine's own address may do

    @classmethod
    def of(cls, host: str, port: int, token: str | None) -> Address:
        """An address with a token where it is open to others: the one given, or a new one.

        ``ValueError`` for a token that could be guessed.
        """
        if token is not None and len(token) < 16:
            raise ValueError("--token needs 16 characters or more: who has it controls the scanner")
        return cls(host, port, token or (None if is_loopback(host) else new_token()))

    @property
    def link(self) -> str:
        """What to open in a browser."""
        name = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(self.host, self.host)  # noqa: S104
        name = f"[{name}]" if ":" in name else name
        return f"http://{name}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    @property
    def names(self) -> frozenset[str]:
        """Names under which the console may be called: those of this machine that need no look-up that others control."""
        if is_loopback(self.host):
            return frozenset({self.host})
        own = {self.host, socket.gethostname(), socket.getfqdn()}
        with suppress(OSError):
            own |= {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None)}
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(("192.0.2.1", 9))  # sends nothing: asks which address would be used
            own.add(str(probe.getsockname()[0]))
        return frozenset(name.lower() for name in own)


def build_app(console: Console, address: Address) -> Any:
    """ASGI application of a console; once a process, since NiceGUI keeps its pages in one place."""
    try:
        from fastapi import FastAPI
        from nicegui import ui
    except ImportError as error:
        raise MissingLibraryError(
            "the Python package nicegui is not installed, which the console needs; run: python -m pip install "
            '"scope-scanner[console]"'
        ) from error
    from scope.console.api import add_api
    from scope.console.pages import add_calibrate, add_history, add_live, add_measure, add_scan

    app = FastAPI(
        title="SCOPE console", version=__version__, openapi_url="/api/v1/openapi.json", docs_url=None, redoc_url=None
    )
    add_api(app, console)
    for add in (add_live, add_calibrate, add_scan, add_measure, add_history):
        add(console)
    ui.run_with(app, title="SCOPE", dark=None, show_welcome_message=False, reconnect_timeout=10.0)
    return Guard(app, address.names, address.token)


def serve(console: Console, address: Address, *, on_ready: Callable[[str], None], show: bool) -> None:
    """Serve until interrupted.

    Raises
    ------
    FileError
        A port that is taken.
    MissingLibraryError
        NiceGUI is not installed.
    """
    import uvicorn

    app = build_app(console, address)
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((address.host, address.port))
    except OSError as error:
        listening.close()
        raise FileError(
            f"{address.host}:{address.port} cannot be listened on ({error.strerror}); close what uses it, or give another --port"
        ) from error
    config = uvicorn.Config(
        app, log_level="critical", access_log=False, proxy_headers=False, server_header=False, date_header=False,
        ws_max_size=1 << 20, h11_max_incomplete_event_size=32768, timeout_graceful_shutdown=3, http="h11",
    )  # fmt: skip
    server = uvicorn.Server(config)

    def tell() -> None:
        while not server.started and not server.should_exit:
            threading.Event().wait(0.05)
        if server.started:
            on_ready(address.link)
            if show:
                webbrowser.open(address.link)

    threading.Thread(target=tell, daemon=True).start()
    with suppress(KeyboardInterrupt):
        server.run(sockets=[listening])
