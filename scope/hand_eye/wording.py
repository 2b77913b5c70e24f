"""Hand and eye in words."""

from __future__ import annotations

import numpy as np

from calibration.digits import two_digits
from calibration.grouping import grouped, shortened
from calibration.notation import COLUMNS, NOTATIONS, numbers_of
from scope.hand_eye.run import HandEyeResult
from scope.session import SENSOR


def hand_eye_text(result: HandEyeResult) -> str:
    """What the terminal shows."""
    verdict = "passed" if result.passed else "NOT PASSED"
    lines = [f"{verdict}: {result.why}"]
    if result.fit is not None:
        fit = result.fit
        sd = np.sqrt(np.diag(fit.covariance))
        source = "stated" if fit.robot_stated else "from the scatter of the views"
        x, y, z = fit.sensor.translation
        lines += [
            f"{SENSOR[fit.mount]}: x {x:.3f} y {y:.3f} z {z:.3f} mm",
            f"one sigma {' '.join(map(two_digits, sd[3:6]))} mm, {' '.join(map(two_digits, np.rad2deg(sd[:3])))} degrees",
            f"rms of the marks {fit.rms_mm:.3f} mm ({fit.rms_px:.2f} px), each view left out {fit.loo_mm:.3f} mm (median)",
            f"robot {fit.robot.mm:.3f} mm, {np.rad2deg(fit.robot.rad):.3f} degrees ({source})",
            *_delay(result),
            "in the notations of robots (mm):",
        ]
        lines += [
            f"  {name:16} {' '.join(COLUMNS[name])} = {' '.join(f'{v:.5g}' for v in numbers_of(name, fit.sensor))}"
            for name in NOTATIONS
            if name != "matrix"
        ]
    elif result.answer is not None:
        answer = result.answer
        sd = np.sqrt(np.diag(answer.covariance))
        x, y, z = answer.sensor.translation
        lines += [
            f"{SENSOR[answer.mount]}: x {x:.3f} y {y:.3f} z {z:.3f} mm, by passes over {'a sphere' if answer.told['by'] == 'sphere' else 'planes'}",
            f"one sigma {' '.join(map(two_digits, sd[:3]))} mm, {' '.join(map(two_digits, np.rad2deg(sd[3:])))} degrees",
            f"rms of the points {answer.told['rms_mm']:.4f} mm, each pass left out {answer.told['loo_mm']:.4f} mm (median)",
        ]
    if result.dropped:
        total = len(result.plan.marks.planes)
        lines.append(f"left out: {grouped([(d['name'], d['reason']) for d in result.dropped], total, 'views')}")
    lines += [f"warning: {shortened(text, 290)}" for text in result.warnings]
    return "\n".join(lines)


def _delay(result: HandEyeResult) -> list[str]:
    if result.answer is None or "delay_s" not in result.answer.told:
        return []
    told = result.answer.told
    return [f"the log is read {told['delay_s']:+.4f} s after an image's time (one sigma {told['delay_sigma_s']:.4f} s)"]
