"""Helpers for the tests: sound servers, reference renderings, a scripted engine, servers, brokers and watchers.

`tests/test_support_*.py` test the most important helpers: comparisons of sound, limits and forking.
"""
