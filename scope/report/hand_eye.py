"""Hand and eye on a page: the answer, every view left out in turn, and what was left out."""

from __future__ import annotations

import numpy as np

from calibration.digits import two_digits
from calibration.geometry import Array
from calibration.notation import COLUMNS, NOTATIONS, numbers_of
from scope.hand_eye import HandEyeResult
from scope.report.page import Page
from scope.report.pictures import with_marks
from scope.session import SENSOR, TARGET

_PICTURES = 6


def hand_eye_page(result: HandEyeResult) -> str:
    """The page of --report."""
    page = Page(f"Hand and eye: {result.plan.path.name}")
    page.verdict("good" if result.passed else "bad", result.why)
    for text in result.warnings:
        page.text(f"Warning: {text}.")
    if result.fit is not None:
        _answer(page, result)
        _views(page, result)
    elif result.answer is not None:
        answer = result.answer
        sd = np.sqrt(np.diag(answer.covariance))
        page.heading("Where the camera is, by passes over a sphere")
        page.table(
            ["", "x mm", "y mm", "z mm", "one sigma, mm", "one sigma, degrees"],
            [
                [
                    SENSOR[answer.mount],
                    *(f"{v:.3f}" for v in answer.sensor.translation),
                    _largest(sd[:3]),
                    two_digits(float(np.rad2deg(sd[3:].max()))),
                ]
            ],
        )
        page.table(
            ["pass", "used", "left out, mm"],
            [[v["name"], "yes" if v["used"] else "no", f"{v['loo_mm']:.4f}"] for v in answer.told["views"]],
        )
    if result.dropped:
        page.heading("Left out")
        page.table(["view", "reason"], [[d["name"], d["reason"]] for d in result.dropped])
    if result.measured:
        page.heading("Marks")
        for name, found in list(result.measured.items())[:_PICTURES]:
            page.image(
                with_marks(found.image, found.marks.pixels, [], None), f"{name}: {len(found.marks)} marks", width=300
            )
    return page.html()


def _answer(page: Page, result: HandEyeResult) -> None:
    fit = result.fit
    if fit is None:
        return
    sd, by_rig = np.sqrt(np.diag(fit.covariance)), np.sqrt(np.maximum(np.diag(fit.of_camera), 0.0))
    page.heading("Where the camera is")
    page.table(
        ["", "x mm", "y mm", "z mm", "one sigma, mm", "of it the rig's", "one sigma, degrees"],
        [
            [name, *(f"{v:.3f}" for v in pose.translation), *(_largest(part) for part in (sd[k + 3 : k + 6], by_rig[k + 3 : k + 6])),
             two_digits(float(np.rad2deg(sd[k : k + 3].max())))]
            for k, name, pose in ((0, SENSOR[fit.mount], fit.sensor), (6, TARGET[fit.mount], fit.target))
        ],
    )  # fmt: skip
    page.table(
        ["notation", "columns", "values (mm)"],
        [[n, " ".join(COLUMNS[n]), " ".join(f"{v:.6g}" for v in numbers_of(n, fit.sensor))] for n in NOTATIONS if n != "matrix"],
    )  # fmt: skip
    source = "stated" if fit.robot_stated else "from the scatter of the views"
    page.text(
        f"Robot: {fit.robot.mm:.3f} mm and {np.rad2deg(fit.robot.rad):.3f} degrees, one sigma of a pose ({source}). Marks: "
        f"{fit.pixel_sigma:.3f} px about each view's own pose; {fit.rms_px:.2f} px ({fit.rms_mm:.3f} mm) from where the robot's "
        "poses, as stated, put them."
    )


def _views(page: Page, result: HandEyeResult) -> None:
    fit = result.fit
    if fit is None:
        return
    page.heading("Each view left out in turn")
    page.text(
        "Left out: rms distance of a view's marks, as the view itself puts them, from where the other views put them; across the "
        "sight: of the sighting rays alone. Robot off: by how much its pose then differs from the stated one."
    )
    page.table(
        ["view", "used", "left out, mm", "across the sight, mm", "robot off, mm", "robot off, degrees"],
        [
            [v.name, "yes" if v.used else "no", f"{v.loo_mm:.3f}", f"{v.loo_ray_mm:.3f}", f"{v.off_mm:.3f}", f"{np.rad2deg(v.off_rad):.3f}"]
            for v in fit.views
        ],
    )  # fmt: skip
    numbers = np.arange(1, len(fit.views) + 1)
    used = np.array([v.used for v in fit.views])
    loo = np.array([v.loo_mm for v in fit.views])
    page.plot(
        [("used", numbers[used], loo[used]), ("left out", numbers[~used], loo[~used])], "Each view against the others",
        x_label="view", y_label="mm", points=True,
    )  # fmt: skip


def _largest(sigma: Array) -> str:
    return two_digits(float(sigma.max()))
