"""The one 3-D viewer of reports, `scope view` and console: a scene of points and parts to what a browser shows, on three.js.

In: a `Scene` (points with scalars, lines, sheets, meshes), made of a cloud or a rig, or by hand.
Out: an element for a page with its script, a page of its own, or bytes and script for a server to give; a still picture.
Read: scene, contents, payload, still, element; then static/: scene.js, colours.js, cloud.js, view.js, parts.js, overlay.js,
    profile.js, panel.js, controls.js, viewer.js. three.js is vendored there (README.md says how it was made).

A report holds the scene itself and works from a folder without network::

    page = viewer_element(cloud_scene(cloud), "the cloud") + viewer_script()

A server gives the script and the scenes as files of their own, and any page of it shows one with an element::

    @app.get("/viewer.js")         -> viewer_code(), text/javascript
    @app.get("/cloud/{name}.bin")  -> scene_bytes(cloud_scene(cloud)), application/octet-stream
    <script src="/viewer.js" defer></script>  ...  <scope-cloud src="/cloud/a.bin" label="cloud a" region></scope-cloud>

In NiceGUI: ``ui.add_head_html('<script src="/viewer.js" defer></script>')`` and ``ui.element("scope-cloud").props('src=...')``;
what was picked, cut or drawn comes as the events ``scope-pick``, ``scope-section`` and ``scope-region`` (see `viewer_code`):
``element.on("scope-region", work, ["detail"])``. `viewer_page` is a whole page for a frame.
"""

from scope.viewer.contents import cloud_scene, mesh_layer, rig_layers, rig_scene
from scope.viewer.element import viewer_code, viewer_element, viewer_page, viewer_script
from scope.viewer.payload import scene_bytes
from scope.viewer.scene import Layer, Scalar, Scene, tilted
from scope.viewer.still import Picture, cloud_from, colour_bgr, still

__all__ = [
    "Layer",
    "Picture",
    "Scalar",
    "Scene",
    "cloud_from",
    "cloud_scene",
    "colour_bgr",
    "mesh_layer",
    "rig_layers",
    "rig_scene",
    "scene_bytes",
    "still",
    "tilted",
    "viewer_code",
    "viewer_element",
    "viewer_page",
    "viewer_script",
]
