"""Files that people write, and how they are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import FileError
from scope.session.toml_file import Flag, Number, Positive, Section, matching, natural_key, numbers, read_csv, read_toml


class Sample(Section):
    format: int
    size: Positive = 1.0
    shift: Number = 0.0
    on: Flag = False


def written(folder: Path, text: str, name: str = "a.toml") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("siez = 2.0", "siez: unknown key"),
        ("size = -1.0", "size: found -1.0; needed"),
        ('size = "2"', "size: found '2'; needed"),
        ("shift = inf", "shift: must be finite"),
        ("on = 1", "on: found 1; needed"),
        ("size = ", "TOML syntax"),
    ],
)
def test_a_wrong_key_or_value_is_named(tmp_path: Path, line: str, told: str) -> None:
    with pytest.raises(FileError, match=r"a\.toml") as error:
        read_toml(written(tmp_path, f"format = 1\n{line}\n"), Sample)
    assert told in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("version", ["", "format = 2", "format = true", 'format = "1"'])
def test_another_format_is_refused(tmp_path: Path, version: str) -> None:
    with pytest.raises(FileError, match="reads format = 1"):
        read_toml(written(tmp_path, version), Sample)


def test_whole_numbers_are_numbers(tmp_path: Path) -> None:
    assert read_toml(written(tmp_path, "format = 1\nsize = 3"), Sample).size == 3.0


@given(st.lists(st.integers(0, 10**6), min_size=2, unique=True))
def test_numbers_in_names_sort_as_numbers(values: list[int]) -> None:
    names = [f"frame{v}.png" for v in values]
    assert sorted(names, key=natural_key) == [f"frame{v}.png" for v in sorted(values)]


def test_a_csv_may_have_more_columns_in_any_order_but_no_short_row(tmp_path: Path) -> None:
    path = written(tmp_path, "\ufeffv, note, u\n1.5,a,2\n2.5,,3\n", "m.csv")
    columns = read_csv(path, ("u", "v"))
    assert np.array_equal(numbers(path, "v", columns["v"]), [1.5, 2.5])
    with pytest.raises(FileError, match="needed too: z"):
        read_csv(path, ("u", "z"))
    with pytest.raises(FileError, match="row 3 has 1 values"):
        read_csv(written(tmp_path, "u,v\n1,2\n3\n", "s.csv"), ("u", "v"))
    with pytest.raises(FileError, match="row 2, u: found 'nan'"):
        numbers(path, "u", ["nan"])


def test_a_pattern_without_files_is_refused(tmp_path: Path) -> None:
    for name in ("f10.png", "f9.png"):
        (tmp_path / name).touch()
    assert [p.name for p in matching(tmp_path, "*.png", owner=tmp_path / "a.toml", key="images")] == [
        "f9.png",
        "f10.png",
    ]
    with pytest.raises(FileError, match=r"images: no file matches '\*\.tif'"):
        matching(tmp_path, "*.tif", owner=tmp_path / "a.toml", key="images")
