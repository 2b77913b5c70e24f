"""What a live image tells: stripe or spots, clipping, focus, exposure, the profile, and why a line has no point."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np

from calibration.errors import ScopeError
from calibration.geometry import Array
from calibration.reason import Reason
from calibration.targets import find_spots
from ranging.background import Image, saturation_level
from ranging.stripe import extract, find_along
from scope.report import why_no_point
from scope.scanning import Scanner
from scope.session import gray

Subject = Literal["stripe", "target"]
_GREEN, _YELLOW, _RED, _BLUE = (96, 220, 90), (40, 200, 250), (70, 70, 255), (255, 170, 60)
_WIDE = 1100  # px, of what is shown
_CLIPPED, _DIM = 0.02, 0.25  # share of clipped lines, and peak over white, beyond which an exposure is no good


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One image, judged."""

    subject: Subject
    size: tuple[int, int]  # px
    histogram: tuple[int, ...]  # 64 bins from black to white
    figures: dict[str, str]  # what is told in words, by name
    advice: str  # what to do about the exposure; empty where nothing
    along: str = ""  # "rows" or "columns" of the stripe
    position: Array = field(default_factory=lambda: np.zeros(0))  # (L,) px
    sigma: Array = field(default_factory=lambda: np.zeros(0))  # (L,) px or mm
    reason: Array = field(default_factory=lambda: np.zeros(0))  # (L,) a `Reason`
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (L, 3) mm
    spots: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) px
    rejected: tuple[tuple[float, float, str], ...] = ()  # spots that are none
    unit: str = "px"  # of sigma
    white: int = 255  # grey level at which the camera clips

    def profile(self) -> list[list[float]]:
        """Pairs (mm along the stripe, mm z) of the points, at most 400."""
        known = np.isfinite(self.points).all(axis=1)
        points = self.points[known]
        if len(points) < 2:
            return []
        flat = points[:, :2] - points[:, :2].mean(axis=0)
        along = flat @ np.linalg.svd(flat, full_matrices=False)[2][0]
        step = max(1, len(points) // 400)
        return np.round(np.column_stack([along, points[:, 2]])[::step], 3).tolist()  # type: ignore[no-any-return]

    def at(self, u: float, v: float) -> str:
        """What stands at a pixel, in words."""
        if self.subject == "target":
            return self._spot_at(u, v)
        line = round(u if self.along == "rows" else v)
        if not 0 <= line < len(self.reason):
            return ""
        what = f"{'column' if self.along == 'rows' else 'row'} {line}"
        code = Reason(int(self.reason[line]))
        if code == Reason.RANGED:
            point = self.points[line] if len(self.points) else np.full(3, np.nan)
            place = f"; ({point[0]:.3f}, {point[1]:.3f}, {point[2]:.3f}) mm" if np.isfinite(point).all() else ""
            return f"{what}: stripe at {self.position[line]:.2f} px, sigma {self.sigma[line]:.4f} {self.unit}{place}"
        return f"{what}: no point: {code.key.replace('_', ' ')}: {why_no_point(code.key)}"

    def _spot_at(self, u: float, v: float) -> str:
        here = np.array([u, v])
        if len(self.spots):
            near = int(np.argmin(np.hypot(*(self.spots - here).T)))
            if np.hypot(*(self.spots[near] - here)) < 15:
                return f"spot at ({self.spots[near, 0]:.2f}, {self.spots[near, 1]:.2f}) px"
        for x, y, why in self.rejected:
            if np.hypot(x - u, y - v) < 15:
                return f"no spot at ({x:.0f}, {y:.0f}) px: {why}"
        return ""


def look_at(image: Image, subject: Subject, scanner: Scanner | None = None) -> Look:
    """Judge one image; a scanner gives points in mm, without one the stripe is told in px."""
    grey = gray(image)
    white = saturation_level(image.dtype)
    histogram = np.histogram(grey[::2, ::2], bins=64, range=(0, white))[0]
    size = (image.shape[1], image.shape[0])
    common: dict[str, Any] = {
        "subject": subject,
        "size": size,
        "histogram": tuple(int(n) for n in histogram),
        "white": white,
    }
    if subject == "target":
        return _target(grey, white, common)
    return _stripe(image, grey, white, common, scanner)


def _stripe(image: Image, grey: Image, white: int, common: dict[str, Any], scanner: Scanner | None) -> Look:
    points = np.zeros((0, 3))
    unit = "px"
    try:
        if scanner is not None:
            found = scanner.profile(image)
            along = scanner.rig.lasers[found.laser].along
            position, sigma, reason, width, peak = found.position, found.sigma, found.reason, found.width, found.peak
            points, unit = found.points, "mm"
        else:
            along = find_along(grey)
            stripe = extract(grey, along=along)
            position, sigma, reason, width, peak = (
                stripe.position,
                stripe.sigma,
                stripe.reason,
                stripe.width,
                stripe.peak,
            )
    except (ScopeError, ValueError) as error:
        return Look(**common, figures={"stripe": "none found"}, advice=" ".join(str(error).split())[:200])
    lit = np.isfinite(position)
    ranged = reason == Reason.RANGED
    clipped = _clipped_lines(grey, white, position, along)
    most = float(np.nanmedian(peak[lit])) if lit.any() else 0.0
    figures = {
        "lines with a point": f"{int(ranged.sum())} of {len(reason)}",
        "stripe, one sigma": f"{np.nanmedian(width[lit]):.2f} px" if lit.any() else "-",
        "sigma, median": f"{np.nanmedian(sigma[ranged]):.4f} {unit}" if ranged.any() else "-",
        "peak, median": f"{most:.0f} of {white}",
        "clipped": f"{100 * clipped:.1f} % of the stripe",
        "focus": f"{focus(grey):.3f}",
    }
    return Look(
        **common, figures=figures, advice=_advice(clipped, most / white, int(lit.sum())), along=along, position=position,
        sigma=sigma, reason=reason.astype(np.float64), points=points, unit=unit,
    )  # fmt: skip


def _target(grey: Image, white: int, common: dict[str, Any]) -> Look:
    try:
        spots = find_spots(grey)
    except (ScopeError, ValueError) as error:
        return Look(**common, figures={"spots": "none found"}, advice=" ".join(str(error).split())[:200])
    clipped = float((spots.saturated > 0.1).mean()) if len(spots) else 0.0
    level = float(np.median(spots.contrast)) / white if len(spots) else 0.0
    figures = {
        "spots": str(len(spots)),
        "not spots": str(len(spots.rejected)),
        "diameter, median": f"{np.median(spots.diameter):.1f} px" if len(spots) else "-",
        "edge, one sigma": f"{np.median(spots.blur):.2f} px" if len(spots) else "-",
        "clipped": f"{100 * clipped:.0f} % of the spots",
        "focus": f"{focus(grey):.3f}",
    }
    advice = (
        _advice(clipped, level, len(spots))
        if len(spots)
        else "no spot found: light the target, focus, or expose longer"
    )
    return Look(**common, figures=figures, advice=advice, spots=spots.centroids, rejected=tuple(spots.rejected))


def focus(grey: Image) -> float:
    """Focus score: energy of the gradient over that of the light (Tenengrad, Krotkov 1988), 0 for a flat image."""
    small = grey[::2, ::2].astype(np.float32)
    gx, gy = cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)
    light = small - float(np.median(small))
    return float(np.sqrt((gx * gx + gy * gy).mean() / max(float((light * light).mean()), 1e-9)) / 8.0)


def _clipped_lines(grey: Image, white: int, position: Array, along: str) -> float:
    """Share of the lines with a stripe whose brightest pixel is clipped."""
    lines = np.flatnonzero(np.isfinite(position))
    if not len(lines):
        return 0.0
    at = np.clip(np.rint(position[lines]).astype(int), 0, grey.shape[0 if along == "rows" else 1] - 1)
    values = grey[at, lines] if along == "rows" else grey[lines, at]
    return float((values >= white).mean())


def _advice(clipped: float, level: float, count: int) -> str:
    if count == 0:
        return "no stripe found: switch the laser on, or expose longer"
    if clipped > _CLIPPED:
        return f"halve the exposure: {100 * clipped:.0f} % of it is clipped"
    if level < _DIM:
        factor = min(8.0, 0.6 / max(level, 0.05))
        return f"expose {factor:.1f} times as long: it reaches {100 * level:.0f} % of white only"
    return ""


def picture(image: Image, look: Look | None, *, overlay: bool = True, width: int = _WIDE) -> bytes:
    """JPEG of an image, at most ``width`` px wide, with what was found drawn on it."""
    grey = gray(image)
    white = saturation_level(image.dtype)
    shown = grey if grey.dtype == np.uint8 else (grey >> 8).astype(np.uint8)
    scale = min(1.0, width / shown.shape[1])
    clipped = grey >= white
    if scale < 1.0:
        size = (round(shown.shape[1] * scale), round(shown.shape[0] * scale))
        shown = np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        clipped = cv2.resize(clipped.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    canvas = cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR)
    if overlay:
        canvas[clipped] = _RED
        if look is not None and look.size == (image.shape[1], image.shape[0]):
            _draw(canvas, look, scale)
    return bytes(cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes())


def _draw(canvas: Any, look: Look, scale: float) -> None:
    for u, v in look.spots * scale:
        cv2.drawMarker(canvas, (round(float(u)), round(float(v))), _GREEN, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
    for u, v, _ in look.rejected:
        cv2.circle(canvas, (round(u * scale), round(v * scale)), 8, _YELLOW, 1, cv2.LINE_AA)
    if not look.along:
        return
    lines = np.flatnonzero(np.isfinite(look.position))
    typical = float(np.nanmedian(look.sigma)) if np.isfinite(look.sigma).any() else np.inf
    for line in lines:
        pair = (line, look.position[line]) if look.along == "rows" else (look.position[line], line)
        ranged = look.reason[line] == Reason.RANGED
        colour = (_GREEN if look.sigma[line] < 2 * typical else _YELLOW) if ranged else _BLUE
        cv2.circle(canvas, (round(float(pair[0]) * scale), round(float(pair[1]) * scale)), 1, colour, -1)
