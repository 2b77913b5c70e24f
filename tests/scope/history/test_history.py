"""Records over time: kept, exported, charted; limits and trends by closed form."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

from calibration.errors import FileError
from scope.history import Journal, Record, chart_of, journal_beside, records_csv


def day(k: int) -> str:
    return f"2026-03-{k + 1:02d}T08:00:00+00:00"


def records(values: list[float], name: str = "heldout_mm") -> list[Record]:
    return [Record("calibrate", True, {name: value}, when=day(k)) for k, value in enumerate(values)]


def test_what_is_added_comes_back_in_order(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "history.db")
    assert journal.records() == []
    journal.add(Record("scan", False, {"points": 12.0, "sigma_mm": float("nan")}, rig="abc", file="c.ply", when=day(3)))
    journal.add(Record("calibrate", True, {"heldout_mm": 0.01}, when=day(1)))
    found = journal.records()
    assert [(r.kind, r.passed, dict(r.figures)) for r in found] == [
        ("calibrate", True, {"heldout_mm": 0.01}),
        ("scan", False, {"points": 12.0}),
    ]
    assert [r.kind for r in journal.records(kind="scan")] == ["scan"]


def test_a_file_that_is_no_history_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "history.db"
    path.write_bytes(b"not a database at all" * 100)
    with pytest.raises(FileError, match="is no history"):
        Journal(path).records()
    with pytest.raises(FileError, match="is no history"):
        Journal(path).add(records([1.0])[0])


def test_names_in_a_record_are_text_and_nothing_else(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "history.db")
    name = "'); DROP TABLE records; --"
    journal.add(Record("scan", True, {}, file=name, camera="=cmd()"))
    assert journal.records()[0].file == name
    rows = list(csv.DictReader(io.StringIO(records_csv(journal.records()))))
    assert rows[0]["camera"] == "'=cmd()"  # no formula for a spreadsheet


def test_the_environment_chooses_or_switches_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SCOPE_HISTORY", raising=False)
    assert journal_beside(tmp_path / "rig.json") == Journal(tmp_path / "history.db")
    monkeypatch.setenv("SCOPE_HISTORY", str(tmp_path / "all.db"))
    assert journal_beside(tmp_path / "x" / "rig.json") == Journal(tmp_path / "all.db")
    monkeypatch.setenv("SCOPE_HISTORY", "off")
    assert journal_beside(tmp_path / "rig.json") is None


def test_limits_of_single_values_by_hand() -> None:
    """Moving ranges 1, 2, 1, 2, 10 of mean 3.2: limits mean +- 2.66 * 3.2 (ISO 7870-2)."""
    chart = chart_of("x", records([10.0, 11.0, 9.0, 10.0, 12.0, 22.0], "x"))
    mean = 74.0 / 6.0
    assert chart.centre == pytest.approx(mean)
    assert (chart.low, chart.high) == (pytest.approx(mean - 2.66 * 3.2), pytest.approx(mean + 2.66 * 3.2))
    assert chart.outside == (5,)


def test_a_steady_drift_meets_its_limit_on_the_day_that_it_says() -> None:
    """0.010 mm on March 1 and 0.001 mm more each day: 0.030 mm on March 21."""
    chart = chart_of("heldout_mm", records([0.010 + 0.001 * k for k in range(10)]), limit=0.030)
    assert chart.slope == pytest.approx(0.001)
    assert chart.recalibrate_by == "2026-03-21"


def test_noise_is_no_trend_and_few_values_have_no_limits() -> None:
    noise = chart_of("heldout_mm", records([0.010, 0.012, 0.009, 0.011, 0.010, 0.012, 0.009]), limit=0.030)
    assert noise.recalibrate_by == ""
    assert chart_of("heldout_mm", records([1.0, 2.0, 3.0])).outside == ()


def test_the_shift_of_a_sheet_is_told_from_the_first_and_limited_on_both_sides() -> None:
    """Closed form: 0.01 mm a day downwards from 17 mm meets 0.2 mm of shift after 20 days."""
    records = [
        Record("calibrate", True, {"red.offset_mm": 17.0 - 0.01 * k}, when=f"2026-03-{k + 1:02d}T12:00:00+00:00")
        for k in range(8)
    ]
    found = chart_of("red.offset_mm", records, limit=0.2, shift=True)
    assert found.values[0] == 0.0
    assert found.recalibrate_by == "2026-03-21"
    assert chart_of("red.offset_mm", records, limit=0.2).recalibrate_by == ""
