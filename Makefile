# make demo    simulate a rig, calibrate it, scan a part with it and compare with the truth (into demo/)
# make test    the test suite
# make long    the tests that take half a minute each: whole ways by clicks in a browser, or command by command
# make lint    formatting, lint, types, the law of imports
# make check   lint, then the test suite
# make clean   remove .venv, demo/ and everything else that git ignores and a tool can make again
#
# Each works alone on a fresh clone: scripts/setup makes .venv and installs what is needed, once, and again whenever
# pyproject.toml changes. PYTHON=/path/to/python3.12 chooses the interpreter; SCOPE_SYSTEM=no forbids installing
# system packages. Works with GNU make 3.81.

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo test long lint check setup clean

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

demo: .venv/demo.stamp
	.venv/bin/scope demo -o demo

test: .venv/test.stamp
	.venv/bin/python -m pytest

long: .venv/test.stamp
	.venv/bin/python -m pytest -m long

lint: .venv/test.stamp
	sh scripts/check lint

check: .venv/test.stamp
	sh scripts/check

setup: .venv/test.stamp

.venv/%.stamp: pyproject.toml scripts/setup
	@sh scripts/setup $*

clean:
	rm -rf .venv demo build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .coverage
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
