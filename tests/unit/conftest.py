"""Settings of the unit tests: examples have no deadline, and CI uses the same examples every time.

`HYPOTHESIS_PROFILE=deep pytest -m '' tests/unit` searches longer for failing examples.
"""

from __future__ import annotations

import os

from hypothesis import settings

settings.register_profile("here", deadline=None, max_examples=50)
settings.register_profile("repeatable", deadline=None, max_examples=50, derandomize=True, database=None)
settings.register_profile("deep", deadline=None, max_examples=5_000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable" if os.environ.get("CI") else "here"))
