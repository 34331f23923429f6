"""What a living engine process writes to standard error is in the server's log, fit for a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.faults.broken import python_path, write

if TYPE_CHECKING:
    from pathlib import Path

    from tests.conftest import MakeTalk

#: A library that complains of each text, with what would colour a terminal.
COMPLAINS = """
import sys
if "talkcli.engine.main" in "".join(sys.orig_argv):
    from pyttsx3.drivers import _espeak
    speak = _espeak.Synth
    def complain(text, *rest, **options):
        sys.stderr.write("cannot say \\x1b[31m" + text.decode() + "\\n")
        sys.stderr.flush()
        return speak(text, *rest, **options)
    _espeak.Synth = complain
"""


def test_what_the_engine_complains_of_is_logged(make_talk: MakeTalk, tmp_path: Path) -> None:
    write(tmp_path / "sitecustomize.py", COMPLAINS)
    talk = make_talk("--player", "null", env=python_path(tmp_path))
    assert talk.run("say", "--wait", "--", "yes").code == 0
    assert r"talk: engine: cannot say \x1b[31myes" in talk.log
