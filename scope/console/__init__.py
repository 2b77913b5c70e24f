"""The console: see what the camera sees, calibrate, scan, measure and look back, in a browser.

In: a session folder and a camera, or a virtual rig.
Out: pages and /api/v1 on this machine's own address; everything made lands in the folder as the commands expect it.
Read: server, safety, console; folder, station, look, steps, recording, measuring, jobs, pictures; api; the room pages.
"""

from scope.console.console import Console
from scope.console.folder import SessionFolder
from scope.console.server import Address, serve

__all__ = ["Address", "Console", "SessionFolder", "serve"]
