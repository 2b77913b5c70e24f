"""A predicted rig as the terminal shows it."""

from __future__ import annotations

from typing import Any

_ROWS = (
    ("noise along the ray, mm", "sigma_mm", "{:.4f}"),
    ("calibration along the ray, mm", "sigma_cal_mm", "{:.4f}"),
    ("pixel along the stripe, mm", "lateral_mm", "{:.4f}"),
    ("pixel across: depth, mm", "depth_mm", "{:.3f}"),
    ("stripe, one sigma, px", "stripe_px", "{:.2f}"),
    ("blur, one sigma, px", "blur_px", "{:.2f}"),
    ("stripe's peak, grey levels", "signal", "{:.0f}"),
    ("triangulation angle, degrees", "triangulation_deg", "{:.1f}"),
)


def design_text(result: dict[str, Any]) -> str:
    """Table of the figures, expected uncertainties, and what is wrong."""
    volume = result.get("volume", result)
    box = result["volume_mm"]
    lines = [
        "working volume, mm: " + ", ".join(f"{axis} {low:.0f} to {high:.0f}" for axis, (low, high) in box.items()),
        f"{'':32}{'least':>10}{'median':>10}{'largest':>10}",
    ]
    for name, key, shape in _ROWS:
        cells = "".join(f"{shape.format(volume[key][part]):>10}" for part in ("min", "median", "max"))
        lines.append(f"{name:32}{cells}")
    lines.append("expected standard uncertainties, k = 1 (scatter, calibration):")
    for name, part in expected_rows(result["expected"]):
        lines.append(f"  {name:30}{part}")
    if result["sheet_in_focus"] is not None:
        tilt = result["sheet_in_focus"]["tilt_deg"]
        lines.append(
            f"the sheet is in focus with focus = {result['sheet_in_focus']['focus_mm']:.0f} mm and the sensor's tilt = "
            f"[{tilt[0]:.2f}, {tilt[1]:.2f}] degrees"
        )
    if "at" in result:
        place = result["at"]
        lines.append(
            f"at {', '.join(f'{v:g}' for v in place['at_mm'])}: {'seen' if place['visible'] else 'not seen'}, noise "
            f"{place['sigma_mm']:.4f} mm, calibration {place['sigma_cal_mm']:.4f} mm, stripe {place['stripe_px']:.2f} px, blur "
            f"{place['blur_px']:.2f} px"
        )
    lines += [f"- {sentence}" for sentence in result["troubles"]]
    return "\n".join(lines)


def expected_rows(expected: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and uncertainty of each thing that may be measured."""

    def of(part: dict[str, float]) -> str:
        return f"{part['sigma_mm']:.4f} mm ({part['scatter_mm']:.4f}, {part['calibration_mm']:.4f})"

    sphere, step, rough, pose = (expected[key] for key in ("sphere", "step", "Sq", "pose"))
    floor = f"{rough['noise_floor_mm']:.4f} mm of noise to subtract, known to {rough['sigma_mm']:.5f} mm"
    return [
        (f"sphere of {sphere['diameter_mm']:g} mm, diameter", of(sphere)),
        (f"step of {step['height_mm']:g} mm", of(step)),
        (f"Sq on {rough['patch_mm']:g} x {rough['patch_mm']:g} mm", floor),
        (f"place of a cube of {pose['cube_mm']:g} mm", f"{of(pose)}, {pose['rotation_deg']:.4f} degrees"),
    ]
