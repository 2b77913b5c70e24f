"""The version of SCOPE, read by the build and by `scope --version`."""

__version__ = "0.1.0"
