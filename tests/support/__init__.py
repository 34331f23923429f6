"""What the tests stand on: a sound server of their own, reference renderings, a scripted engine, servers and watchers.

Nothing here tests anything. `tests/test_support_*.py` test what other tests trust most: sound, limits and forking.
No module here imports talk's server or engine.
"""
