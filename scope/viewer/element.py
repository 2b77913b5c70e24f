"""The viewer in a page: one element that needs nothing else, its script, or a page of its own."""

from __future__ import annotations

import base64
import html
import json
import zlib
from functools import cache
from importlib.resources import files

import cv2

from scope.viewer.payload import scene_bytes
from scope.viewer.scene import Scene
from scope.viewer.still import still

THREE = "three-0.187.0.min.js"
_ORDER = ("scene", "colours", "cloud", "view", "parts", "overlay", "profile", "panel", "controls", "viewer")
_START = (
    '<script>(async()=>{const t=document.getElementById("scope-viewer").textContent,b=Uint8Array.from(atob(t),c=>c.charCodeAt(0)),'
    's=document.createElement("script");s.textContent=await new Response(new Blob([b]).stream().pipeThrough(new '
    'DecompressionStream("deflate"))).text();document.head.append(s)})()</script>'
)


@cache
def viewer_code() -> str:
    """The viewer as one script, three.js in it, for a server to give: it defines the element ``<scope-cloud>``.

    Written in a page of your own server as ``<script src="/viewer.js" defer></script>``, after which each
    ``<scope-cloud src="/cloud/name.bin">`` that appears in the document, whoever puts it there, shows the scene that is
    fetched from its ``src`` (the bytes of `scene_bytes`). Attributes:

    - ``label``: what a screen reader says;
    - ``fill``: as high as the window, or as the page's own style says; without it, as high as it needs to be;
    - ``region``: offers to draw a rectangle, seen along z.

    Events, which bubble: ``scope-pick`` with ``detail.picked`` (``row``, ``point`` in mm, ``values`` by name) and
    ``detail.distance`` in mm or null; ``scope-section`` with ``detail.points`` and ``detail.place``; ``scope-region`` with
    ``detail.x`` and ``detail.y``, each [from, to] in mm.
    """
    place = files("scope.viewer") / "static"
    style = json.dumps((place / "viewer.css").read_text(encoding="utf-8"))
    parts = [(place / f"{name}.js").read_text(encoding="utf-8") for name in _ORDER]
    three = (place / THREE).read_text(encoding="utf-8")
    return "\n".join(
        [
            '(() => {"use strict"; if (customElements.get("scope-cloud")) return;',
            three,
            f"const STYLE = {style};",
            *parts,
            "})();",
        ]
    )


@cache
def viewer_script() -> str:
    """What a self-contained page holds once, at its end: the viewer, deflated, and the line that starts it."""
    packed = base64.b64encode(zlib.compress(viewer_code().encode("utf-8"), 9)).decode("ascii")
    return f'<script type="text/plain" id="scope-viewer">{packed}</script>{_START}'


def viewer_element(scene: Scene, label: str, *, fill: bool = False, region: bool = False) -> str:
    """HTML of one viewer with its scene and, for print and where there is no WebGL, a still picture of it.

    It needs `viewer_script` once in the page. ``label`` describes it for those who do not see it; it is escaped.
    """
    told = html.escape(label, quote=True)
    picture = base64.b64encode(_webp(scene)).decode("ascii")
    data = base64.b64encode(scene_bytes(scene)).decode("ascii")
    words = f"{' fill' if fill else ''}{' region' if region else ''}"
    return (
        f'<scope-cloud label="{told}"{words}><img class="still" alt="{told}" src="data:image/webp;base64,{picture}">'
        f'<script type="text/plain" class="scene">{data}</script></scope-cloud>'
    )


def viewer_page(scene: Scene, title: str, *, region: bool = False) -> str:
    """A page that holds one viewer and nothing else, as high as its window; for a frame in another page."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>:root{{color-scheme:light dark}}body{{margin:0}}img{{max-width:100%}}</style></head><body>"
        f"{viewer_element(scene, title, fill=True, region=region)}{viewer_script()}</body></html>\n"
    )


def _webp(scene: Scene) -> bytes:
    return bytes(cv2.imencode(".webp", still(scene), [cv2.IMWRITE_WEBP_QUALITY, 82])[1].tobytes())
