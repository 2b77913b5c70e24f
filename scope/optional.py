"""Heavy libraries that are imported when they are first needed, and what to install where one is missing."""

from __future__ import annotations

import sys
from typing import Any

from scope.errors import MissingLibraryError


def import_open3d() -> Any:
    """Return the module ``open3d``; `MissingLibraryError` names the command that installs what it lacks.

    Open3D needs system libraries (libusb, OpenGL, OpenMP) that its wheel does not carry: their absence shows as an
    ``OSError`` or ``ImportError`` on import.
    """
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise MissingLibraryError(
            f"the Python package open3d is not installed ({error.name}), which poses and meshes need; "
            "run: python -m pip install open3d"
        ) from error
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"open3d does not load ({' '.join(str(error).split())}); a system library is missing: run: {_system_command()}"
        ) from error
    return open3d


def _system_command() -> str:
    if sys.platform == "darwin":
        return "brew install libusb"
    return "apt-get install libusb-1.0-0 libgl1 libgomp1 libx11-6 (Debian, Ubuntu; other systems: the same libraries)"
