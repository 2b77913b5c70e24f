"""Figures, each beside its peer or its limit: ``python -m benchmarks.NAME``."""
