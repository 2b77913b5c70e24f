"""Commented calibration files to fill in."""

from __future__ import annotations

from pathlib import Path

from calibration.atomic import write_text
from calibration.errors import FileError

_HEAD = """\
# How this camera and its lasers are calibrated: scope calibrate calibration.toml -o rig.json
format = 1
units = "mm"                        # "mm" | "cm" | "m" | "inch"
# camera_id = "cell-3-left"         # a capture that names another camera is refused
"""
_TARGET = {
    "spots": """
[target]
kind = "spots"
polarity = "light"                  # light spots on dark ground (back-lit), or "dark"
rows = 15
columns = 21
pitch = 15.0                        # between neighbouring spots; [x, y] where they differ
diameter = 5.0                      # of a spot
fiducials = [[7, 10], [7, 12], [4, 10]]   # [row, column] from 0 of the larger spots: an L with unequal arms
fiducial_diameter = 7.5
""",
    "chessboard": """
[target]
kind = "chessboard"
rows = 7                            # inner corners
columns = 11
pitch = 20.0                        # side of a square
""",
    "charuco": """
[target]
kind = "charuco"
rows = 8                            # squares
columns = 11
pitch = 20.0                        # side of a square
marker = 15.0                       # side of a marker
dictionary = "DICT_5X5_100"
""",
    "markers": """
[target]
kind = "markers"
dictionary = "DICT_4X4_50"
marker = 30.0                       # side of a marker's black square
places = [                          # centre of each, x to the right and y down; turn = degrees from x to y
    { id = 0, x = 0.0, y = 0.0 },
    { id = 1, x = 100.0, y = 0.0 },
    { id = 2, x = 200.0, y = 0.0 },
    { id = 3, x = 0.0, y = 110.0 },
    { id = 4, x = 100.0, y = 110.0 },
    { id = 5, x = 200.0, y = 110.0 },
]
""",
    "circles": """
[target]
kind = "circles"                    # OpenCV's asymmetric grid
polarity = "dark"
rows = 13
columns = 5                         # circles a row
pitch = 12.0                        # neighbours along a diagonal are that far apart in x and in y
diameter = 9.0
""",
}
_JIG = """
# What "passed" means for your work; without it only self-consistency is judged.
# [accept]
# ray_mm = 0.02                     # held-out rms of the sighting rays
# laser_mm = 0.02                   # rms of the laser's points about its sheet
# repeat_px = 0.05                  # movement between repeated images

# [laser]
# along = "auto"                    # the stripe runs along image "rows" or "columns"
# channel = "auto"                  # "red" | "green" | "blue" | "gray"
# origin = [0.0, -190.0, 10.0]      # about where the light comes from

# One [[plane]] for every stand-off of the jig; three or more, so that a fault can show.
[[plane]]
name = "w340"
images = "w340/*.png"               # repeats are averaged
origin = [-150.0, -105.0, 340.0]    # where mark (0, 0) is, in the jig's frame
laser = "w340-laser/*.png"          # the same pose, laser on
# background = "w340-dark/*.png"    # the same pose, laser off

[[plane]]
name = "w400"
images = "w400/*.png"
origin = [-150.0, -105.0, 400.0]
laser = "w400-laser/*.png"

[[plane]]
name = "w460"
images = "w460/*.png"
origin = [-150.0, -105.0, 460.0]
laser = "w460-laser/*.png"
"""
_FREEHAND = """
# [laser]
# channel = "red"

# Views held by hand: ten or more, tilted by 20 degrees and more about both axes. With an `origin`, as on a jig, the
# poses would be taken as known.
[[plane]]
images = "pose01.png"
laser = "pose01-laser.png"          # the same pose, laser on
background = "pose01.png"           # the same pose, laser off

[[plane]]
images = "pose02.png"
laser = "pose02-laser.png"
background = "pose02.png"

[[plane]]
images = "pose03.png"
laser = "pose03-laser.png"
background = "pose03.png"
"""
TEMPLATES = {
    "spots": _HEAD + _TARGET["spots"] + _JIG,
    "chessboard": _HEAD + _TARGET["chessboard"] + _FREEHAND,
    "charuco": _HEAD + _TARGET["charuco"] + _FREEHAND,
    "markers": _HEAD + _TARGET["markers"] + _FREEHAND,
    "circles": _HEAD + _TARGET["circles"] + _FREEHAND,
}


def write_template(path: Path, kind: str) -> None:
    """Write the template of a kind of target; ``FileError`` where the file is already there."""
    if path.exists():
        raise FileError(f"{path}: is already there; move it away or name another file")
    write_text(path, TEMPLATES[kind])
