"""Pictures of clouds: from two sides while a scan grows, and to be turned when it is there."""

from __future__ import annotations

import cv2
import numpy as np

from calibration.geometry import Array
from scope.cloud import ScanCloud
from scope.report import Page, cloud_from


def jpeg_of(points: Array, side: str) -> bytes:
    """JPEG of points (N, 3) mm seen along z ("top") or along y ("side"), coloured by z."""
    x, y, z = np.eye(3)
    picture = cloud_from(points, points[:, 2], x, y if side == "top" else z, width=560)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes())


def viewer_page(cloud: ScanCloud, name: str) -> str:
    """A page that holds the viewer of the reports and nothing else."""
    page = Page(name)
    page.cloud(cloud.points, cloud.points[:, 2], "Coloured by z. Drag to turn, wheel to zoom, shift-drag to move")
    bare = (
        "<style>html,body{background:#10151c!important}main{gap:0!important}html,body,.page,main,figure{margin:0!important;padding:0!important;max-width:none!important;width:100%!important;"
        "display:block!important;border:0!important;overflow:hidden}h1,nav,footer,figcaption{display:none!important}"
        ".cloud{width:100vw!important;height:100vh!important;max-height:none!important;border-radius:0!important}</style>"
    )
    return page.html().replace("</head>", f"{bare}</head>", 1)
