"""The benchmark: `python -m tests.bench` (see `__main__`), and in test_*.py what of it must hold on any machine."""
