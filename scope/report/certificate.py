"""A rig's certificate as one page: verdict, uncertainty budget, calibration, verifications and checks."""

from __future__ import annotations

from calibration.digits import two_digits
from scope.check import Budget, Certificate
from scope.report.page import Page

_SOURCE = "GUM (JCGM 100:2008); along the sighting ray, root mean square over the calibrated part of the sheet"


def certificate_page(found: Certificate) -> str:
    """One self-contained HTML page, to be printed and filed."""
    rig = found.rig
    page = Page(f"SCOPE certificate of rig {rig.sha256[:12]}")
    words = "May be used" if found.passed else "Must not be used"
    page.verdict("good" if found.passed else "bad", f"{words}: {found.why}.")
    if not rig.sealed:
        page.verdict("warn", "This rig has no seal (it is of an earlier version): an alteration would not be seen.")
    for budget in found.budgets:
        _add_budget(page, budget)
    page.heading("Calibration")
    limits = ", ".join(f"{key} {value:g}" for key, value in rig.accept.items()) or "none"
    page.table(
        ("what", "value"),
        [
            ["verdict", f"{'passed' if rig.verification.passed else 'not passed'}: {rig.verification.why}"],
            ["limits that were asked for", limits],
            ["calibrated", rig.written or "not said"],
            ["with", rig.software or "not said"],
            ["images and files", str(len(rig.inputs))],
        ],
    )
    page.heading("Verifications and checks")
    if found.evidence:
        page.table(
            ("file", "kind", "good", "figures", "sha256"),
            [[e.name, e.kind, "yes" if e.good else "no", e.told, e.sha256[:12]] for e in found.evidence],
            marked={k for k, e in enumerate(found.evidence) if not e.good},
        )
    else:
        page.text("None was given: what is above rests on the calibration's own planes alone.")
    page.about_rig(rig)
    page.about("operator", found.operator)
    return page.html()


def _add_budget(page: Page, budget: Budget) -> None:
    page.heading(f"Uncertainty budget of laser {budget.laser}")
    near, far = budget.stand_off
    page.text(
        f"Of one point, at stand-offs of {near:.0f} to {far:.0f} mm; {_SOURCE}. Combined standard uncertainty {two_digits(budget.combined)} mm, expanded "
        f"(k = 2) {two_digits(budget.expanded)} mm. Only the stripe's part shrinks where points are averaged."
    )
    page.table(
        ("source", "type", "standard uncertainty", "sensitivity, mm per unit", "contribution, mm", "share", "from"),
        [
            [
                source.name,
                source.kind,
                "-" if source.standard is None else f"{source.standard:.2g} {source.unit}",
                f"{source.sensitivity:.3g}",
                "-" if source.contribution is None else two_digits(source.contribution),
                "-" if (share := budget.share(source)) is None else f"{100 * share:.1f} %",
                source.why,
            ]
            for source in budget.sources
        ],
    )
    if budget.missing:
        page.verdict("warn", f"Not in it, since it was not stated: {', '.join(budget.missing)}.")
