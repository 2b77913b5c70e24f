"""A predicted rig as the terminal shows it."""

from __future__ import annotations

from typing import Any

_ROWS = (
    ("noise along the ray, mm", "sigma_mm", "{:.4f}"),
    ("calibration along the ray, mm", "sigma_cal_mm", "{:.5f}"),
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
    if result["hidden"] is not None:
        hidden = result["hidden"]
        lines.append(
            f"of the objects, seen along z: {hidden['seen']:.1%} in sight of both, {hidden['laser_hidden']:.1%} without laser, "
            f"{hidden['camera_hidden']:.1%} unseen by the camera, {hidden['both_hidden']:.1%} neither, {hidden['outside']:.1%} never on the sheet in view"
        )
    lines += [f"- {sentence}" for sentence in result["troubles"]]
    return "\n".join(lines)


def expected_rows(expected: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and uncertainty of each thing that may be measured."""

    def of(part: dict[str, float]) -> str:
        return f"{length(part['sigma_mm'])} ({length(part['scatter_mm'])}, {length(part['calibration_mm'])})"

    sphere, step, rough, pose = (expected[key] for key in ("sphere", "step", "Sq", "pose"))
    floor = f"{length(rough['noise_floor_mm'])} of noise to subtract, known to {length(rough['sigma_mm'])}"
    return [
        (f"sphere of {sphere['diameter_mm']:g} mm, diameter", of(sphere)),
        (f"step of {step['height_mm']:g} mm", of(step)),
        (f"Sq on {rough['patch_mm']:g} x {rough['patch_mm']:g} mm", floor),
        (f"place of a cube of {pose['cube_mm']:g} mm", f"{of(pose)}, {pose['rotation_deg']:.2g} degrees"),
    ]


def length(mm: float) -> str:
    """A length in mm, or in um where that is shorter to read."""
    return f"{mm * 1e3:.2g} um" if abs(mm) < 0.0095 else f"{mm:.2g} mm"


def figure_name(key: str) -> str:
    """What a figure of the draws is: ``sigma_mm.median`` is the median noise along the ray."""
    names = {key: name for name, key, _ in _ROWS}
    things = {"sphere": "sphere's diameter, mm", "step": "step, mm", "Sq": "Sq, mm", "pose": "place of a cube, mm"}
    first, part, *_ = key.split(".")
    if first == "expected":
        return f"uncertainty: {things.get(part, part)}"
    return f"{names.get(first, first)} ({'largest' if part == 'max' else part})"


def proposal_text(proposal: dict[str, Any]) -> str:
    """What a brief led to, and what each lens would cost."""
    chosen = proposal["proposed"]
    size = " x ".join(f"{side:g}" for side in proposal["volume_mm"])
    lines = [
        (
            f"wanted: {proposal['sigma_mm']:g} mm over {size} mm: {'proposed' if proposal['met'] else 'NOT POSSIBLE, the nearest'}: lens "
            f"{chosen['focal_mm']:g} mm, stand-off {chosen['stand_off_mm']:.0f} mm, baseline {chosen['baseline_mm']:.0f} mm "
            f"({chosen['angle_deg']:g} degrees), noise {chosen['sigma_mm']:.4f} mm at most"
        ),
        f"{'lens, mm':>10}{'angle':>8}{'stand-off':>11}{'baseline':>10}{'laser, mm':>11}{'noise, mm':>11}{'blur, px':>10}",
    ]
    for c in proposal["choices"]:
        lines.append(
            f"{c['focal_mm']:>10g}{c['angle_deg']:>8g}{c['stand_off_mm']:>11.0f}{c['baseline_mm']:>10.0f}{c['laser_width_mm']:>11.3f}{c['sigma_mm']:>11.4f}"
            f"{c['blur_px']:>10.2f}"
        )
    return "\n".join(lines)


def draws_text(drawn: dict[str, Any]) -> str:
    """What tolerances do to each figure."""
    lines = [
        f"{drawn['draws']} rigs drawn: {drawn['failed']} cannot be calibrated, {drawn['troubled']} have something that will not work",
        f"{'':42}{'5 %':>12}{'median':>12}{'95 %':>12}",
    ]
    for name, part in drawn["figures"].items():
        lines.append(f"{figure_name(name):42}{part['p5']:>12.4g}{part['p50']:>12.4g}{part['p95']:>12.4g}")
    return "\n".join(lines)
