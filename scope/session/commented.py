"""Commented capture.toml, rig-design.toml and acceptance.toml to fill in."""

from __future__ import annotations

from pathlib import Path

from calibration.atomic import write_text
from calibration.errors import FileError

_CAPTURE = """\
# One scan: scope scan capture.toml --rig rig.json -o cloud.ply
format = 1
units = "mm"                        # "mm" | "cm" | "m" | "inch"
images = "frames/*.png"             # in natural order: frame2 before frame10
# video = "scan.mp4"                # instead of images; or camera = 0, with frames = 200
# camera_id = "cell-3-left"         # must be the rig's
# background = "off/*.png"          # the laser off, subtracted
# background_mode = "mean"          # "mean" | "paired" (one a frame) | "alternate" (on, off, on, off...)
# channel = "auto"                  # "red" | "green" | "blue" | "gray" | "red-excess" ...
# lasers = ["red"]                  # those that shine; otherwise all of the rig

# How the object, or the sensor, moved from frame to frame.
[motion]
kind = "linear"                     # "fixed" | "linear" | "turntable" | "poses"
moves = "object"                    # or "sensor"
direction = [1.0, 0.0, 0.0]         # in the rig's frame; or "rig", where a stage was calibrated
step = 0.5                          # mm a frame
start = 0.0
# positions = "positions.csv"       # instead of start and step: header frame,position; with a camera it may grow
# log = "stage.csv"                 # instead: header seconds,position, met by the frames' time stamps
# delay = 0.0                       # s to be added to those

# [motion]
# kind = "turntable"
# moves = "object"
# axis = "rig"                      # or axis_point and axis_direction
# step = 1.0                        # degrees a frame
"""
_DESIGN = """\
# A rig to be built: scope design rig-design.toml predicts it, scope simulate rig-design.toml -o DIR renders it.
# Frame C: the camera looks along +z, x to the right, y down. Lengths mm, angles degrees.
format = 1

[camera]
size = [1280, 960]                  # px, columns and rows
centre_px = [639.5, 479.5]
pixel_um = 4.8                      # from the data sheets; or focal_px instead of pixel_um and focal_mm
focal_mm = 8.0
f_number = 5.6
focus = 400.0                       # mm along z to what is sharp
# tilt = [0.0, 0.0]                 # of the sensor about x, then y; scope design proposes one that suits the sheet
full_well_e = 10000.0               # electrons at white; or gain_e, electrons a grey level
read_noise_e = 12.0                 # electrons; or read_noise, grey levels
blur_px = 0.5                       # of the lens itself, one sigma
# distortion = [-0.18, 0.05, 0.0, 0.0, 0.0]   # OpenCV's order: k1 k2 p1 p2 k3
# exposure_us = 2000.0              # with quantum_efficiency, where the laser's power_mw is given
# quantum_efficiency = 0.5

[laser]
origin = [0.0, -190.0, 0.0]         # above the camera: the stripe runs along image rows
through = [0.0, 0.0, 400.0]
roll = 0.0
width = 0.25                        # one sigma, the same everywhere; or a Gaussian beam:
# waist = 0.08                      # one sigma where it is thinnest
# waist_at = 440.0                  # from the laser
# wavelength_nm = 660.0
# power_mw = 5.0                    # with the camera's exposure; otherwise
peak = 160.0                        # grey levels of white that faces the laser, before blur

# [window]                          # flat glass before both
# thickness = 10.0
# index = 1.52
# tilt = [0.0, 0.0]
# distance = 100.0

[jig]
stand_offs = [360, 400, 440]        # three or more, so that a fault can show
rows = 15
columns = 21
pitch = 12.0
diameter = 4.5
fiducials = [[7, 10], [7, 12], [4, 10]]
fiducial_diameter = 6.8

# What mounting and making leave open, one sigma each: scope design --draws 50
[tolerance]
laser_position = 0.5                # mm, each axis
laser_angle = 0.2                   # degrees
stand_off = 0.02                    # mm, of each plane, of which the calibration does not know
slip = 0.02

# [[object]]                        # with [motion], where a scan is to be simulated, too
# solid = "sphere"
# radius = 20.0
# origin = [0.0, 0.0, 400.0]

# [motion]
# kind = "linear"
# direction = [0, 1, 0]
# step = 0.5
# start = -25.0
# frames = 100
"""
_ACCEPTANCE = """\
# A scanner's acceptance test: scope check --acceptance acceptance.toml --report protocol.html
format = 1
units = "mm"
standard = "vdi-2634-2"             # or "iso-10360-13"
# scanner = "cell 3, left"
# operator = ""
volume = [160.0, 120.0, 100.0]      # the measuring volume
temperature = 20.0                  # degrees Celsius, of the artefacts
temperature_uncertainty = 0.5       # k = 2

# The largest errors that the maker of the scanner permits (or that you do): the standard names none.
[limits]
probing_form = 0.05
probing_size = 0.05
spacing = 0.05
flatness = 0.05

# A sphere at ten places of the volume. From its certificate: diameter, its uncertainty (k = 2), its own form.
[sphere]
scans = "sphere/*.ply"
diameter = 25.0012
uncertainty = 0.0005
form = 0.0003
form_uncertainty = 0.0002
expansion = 5.5                     # 1e-6 per kelvin
certificate = "number and date"
# region = "box:-20,60,-20,20"      # where it is, should its holder be taken for it
# positions = 10                    # where your document asks for another number

# Two spheres at a known distance of their centres, in seven positions.
[ball_bar]
scans = "bar/*.ply"
distance = 100.0031
diameters = [25.0012, 25.0008]
uncertainty = 0.001
expansion = 1.0

# A flat plate in six positions; form is its calibrated flatness.
[plane]
scans = "plane/*.ply"
form = 0.001
form_uncertainty = 0.0005
"""
FILES = {"capture.toml": _CAPTURE, "rig-design.toml": _DESIGN, "acceptance.toml": _ACCEPTANCE}


def write_commented(path: Path, name: str) -> None:
    """Write a commented file of `FILES` to fill in; ``FileError`` where one is already there."""
    if path.exists():
        raise FileError(f"{path}: is already there; move it away or name another file")
    write_text(path, FILES[name])
