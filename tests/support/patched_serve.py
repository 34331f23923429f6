"""A server with the scripted engine and changed constants."""

from __future__ import annotations

from pathlib import Path

_PROGRAM = """
import sys
sys.path.insert(0, {root!r})
from talkcli.server import connection, requests, speech, subscribers
from tests.support import scripted_serve
{assignments}
scripted_serve.main()
"""


def patched_serve(directory: Path, **constants: float) -> str:
    """Write a program that serves with these constants of `talkcli.server`, such as `requests__PAUSE_ANSWER_S`."""
    assignments = "\n".join(f"{name.replace('__', '.')} = {value}" for name, value in constants.items())
    path = directory / "serve.py"
    path.write_text(_PROGRAM.format(root=str(Path(__file__).parents[2]), assignments=assignments), encoding="utf-8")
    return str(path)
