"""The stripe as a ridge of the image surface, along the normal of a tilted or curved stripe.

Steger, An unbiased detector of curvilinear structures, IEEE PAMI 20, 113 (1998): the image is convolved with derivatives
of a Gaussian; where the first derivative along the direction of greatest second derivative vanishes, there is the
ridge. The smoothing runs along the stripe too, so that neighbouring lines share their noise (about 2.5 widths of it):
the position is quieter than that of one line alone, and details of the surface are as much smoother.
"""

from __future__ import annotations

import math

import numpy as np

from calibration.compiled import compiled
from calibration.geometry import Array
from ranging.stripe._table import DIVERGED, GOOD, PEAK, POSITION, SIGMA, STATE, CameraNoise, Lines

STEEPEST = 0.25  # least share of the normal that lies across the line: a stripe within 14 degrees of the line has none


@compiled
def ridge_lines(lines: Lines, scale: float, camera: CameraNoise, table: Array) -> None:
    """Replace positions and sigmas of ``table`` by those of the ridge at ``scale`` px.

    A line whose neighbourhood leaves the image, or whose ridge runs nearly along the line, becomes DIVERGED.
    """
    pixels, dark, (count, length, line_step, pixel_step), _, _ = lines
    has_dark = dark.size > 0
    reach = math.ceil(3.0 * scale)
    size = 2 * reach + 1
    g0, g1, g2 = np.empty(size), np.empty(size), np.empty(size)  # along the stripe
    c0, c1, c2 = np.empty(size), np.empty(size), np.empty(size)  # across it
    for k in range(size):
        u = (k - reach) / scale
        g0[k] = math.exp(-0.5 * u * u) / (scale * 2.5066282746310002)
        g1[k] = u / scale * g0[k]  # of a correlation: the sign of the derivative is turned
        g2[k] = (u * u - 1.0) / (scale * scale) * g0[k]
    for i in range(count):
        if table[STATE, i] != GOOD:
            continue
        position = table[POSITION, i]
        done = False
        for _ in range(6):
            if not 0.0 <= position < length:
                break
            centre = int(position + 0.5)
            # about the position itself: one step from the middle of a pixel errs by up to 0.05 px
            for k in range(size):
                u = (k - reach + centre - position) / scale
                c0[k] = math.exp(-0.5 * u * u) / (scale * 2.5066282746310002)
                c1[k] = u / scale * c0[k]
                c2[k] = (u * u - 1.0) / (scale * scale) * c0[k]
            if i < reach or i >= count - reach or centre < reach or centre >= length - reach:
                break
            ga, gc, haa, hac, hcc = 0.0, 0.0, 0.0, 0.0, 0.0
            for m in range(size):
                s0, s1, s2 = 0.0, 0.0, 0.0
                for k in range(size):
                    at = (i + m - reach) * line_step + (centre + k - reach) * pixel_step
                    value = np.float64(pixels[at])
                    if has_dark:
                        value -= dark[at]
                    s0 += c0[k] * value
                    s1 += c1[k] * value
                    s2 += c2[k] * value
                ga += g1[m] * s0
                gc += g0[m] * s1
                haa += g2[m] * s0
                hac += g1[m] * s1
                hcc += g0[m] * s2
            # Unit normal (along, across): eigenvector of the most negative eigenvalue.
            half, difference = 0.5 * (haa + hcc), 0.5 * (haa - hcc)
            root = math.sqrt(difference * difference + hac * hac)
            curvature = half - root
            na, nc = hac, curvature - haa
            norm = math.hypot(na, nc)
            if norm < 1e-12:
                na, nc = (0.0, 1.0) if hcc < haa else (1.0, 0.0)
            else:
                na, nc = na / norm, nc / norm
            if curvature >= 0.0 or abs(nc) < STEEPEST:
                break
            shift = -(ga * na + gc * nc) / (curvature * nc)
            position += min(max(shift, -1.0), 1.0)
            if abs(shift) < 0.003:
                noise = 0.0
                for m in range(size):
                    for k in range(size):
                        weight = na * g1[m] * g0[k] + nc * g0[m] * g1[k]
                        bright = table[PEAK, i] * math.exp(-0.5 * (((k - reach) * nc + (m - reach) * na) / scale) ** 2)
                        noise += weight * weight * (camera.variance + bright / camera.gain_e)
                table[POSITION, i] = position
                table[SIGMA, i] = math.sqrt(noise) / abs(curvature * nc)
                done = True
                break
        if not done:
            table[STATE, i] = DIVERGED
