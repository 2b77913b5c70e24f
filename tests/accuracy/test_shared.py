"""Captures that are not part of the project: the tables of figures, with small margins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
pytestmark = [pytest.mark.shared, pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is absent")]


def test_piv_e_is_as_good_as_others_found_it() -> None:
    from scope.calibrating import calibrate

    found = calibrate(DATA / "piv-e/calibration.toml", order=2)
    fits = found.two_plane.planes
    assert np.sqrt(np.mean([f.fit_px**2 for f in fits])) < 0.090 * 1.02
    assert np.sqrt(np.mean([f.loo_px**2 for f in fits])) < 0.107 * 1.02
    assert found.verdict.content["interplane_px"] < 0.012 * 1.05
