"""Pixels to sighting rays: targets, spots, plane maps, cameras, sheets of light, and the proof of them.

In: marks of a target on several planes (or the images of them), points of the laser's light on those planes.
Out: a `Rig`: a camera that gives a ray to every pixel, sheets of light, stages, and the faults of each by name.
Read: errors, reason, geometry, notation, camera, volume, rig; then the rooms targets, rays, sheet, stages,
    verification. Tools: digits, grouping, notebook, compiled, threads, checked,
    atomic, seal.
"""
