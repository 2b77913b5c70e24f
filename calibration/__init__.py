"""Pixels to sighting rays: targets, spots, plane maps, cameras, sheets of light, and the proof of them."""
