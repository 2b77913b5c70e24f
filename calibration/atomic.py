"""Files appear whole or not at all: written beside, then renamed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from calibration.errors import FileError


@contextmanager
def beside(path: Path) -> Iterator[Path]:
    """Name an empty sibling of ``path`` to write to, renamed to ``path`` when the block ends well.

    Nothing is left behind when the block fails. ``FileError`` where the folder does not exist or cannot be written.
    """
    require_folder(path)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        os.close(handle)
        part = Path(name)
        try:
            yield part
            part.chmod(0o644)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise FileError(
            f"{path}: could not be written ({error.strerror}); free space or choose another place"
        ) from error


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file that appears at ``path``, whole, when the block ends well; see `beside`."""
    with beside(path) as part, part.open("wb") as stream:
        yield stream


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8) whole."""
    with written_whole(path) as stream:
        stream.write(text.encode("utf-8"))


def require_folder(*paths: Path | None) -> None:
    """``FileError`` unless the folders that are to hold these files exist, before any work is done for them; None asks for nothing."""
    for path in paths:
        if path is None:
            continue
        if not path.parent.is_dir():
            raise FileError(f"{path}: its folder {path.parent} does not exist; create it or choose another place")
        if path.is_dir():
            raise FileError(f"{path}: is a folder; name a file in it")
        if not os.access(path.parent, os.W_OK):
            raise FileError(f"{path}: its folder {path.parent} cannot be written; choose a folder you may write to")
