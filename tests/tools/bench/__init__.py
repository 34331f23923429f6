"""The benchmark: `python -m tests.tools.bench`."""
