"""What is known of some commands without click. Made by `python -m talkcli.cli.tabulate`: don't edit it.

An option: its name for click, and True or False, the value of a flag; or "text"; or "int" or "float" and its limits.
"""

from __future__ import annotations

from talkcli.frozen import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Any

# fmt: off
COMMON: dict[str, Any] = (
{"--socket": ("socket", "text"), "--json": ("json", True), "-q": ("quiet", True), "--quiet": ("quiet", True)}
)
COMMANDS: dict[str, Any] = (
{"say": {"argument": ("text", -1),
         "options": {"-w": ("wait", True),
                     "--wait": ("wait", True),
                     "-t": ("timeout", "float", 5e-324, None),
                     "--timeout": ("timeout", "float", 5e-324, None),
                     "-f": ("feedback", True),
                     "--feedback": ("feedback", True),
                     "--preempt": ("preempt", True),
                     "--queue": ("preempt", False),
                     "--flush": ("flush", True),
                     "--priority": ("priority", "int", None, None),
                     "--ttl": ("ttl", "float", 0, None),
                     "--key": ("key", "text"),
                     "--throttle": ("throttle", "float", 0, None),
                     "--id": ("id", "text"),
                     "--as": ("name", "text"),
                     "--rate": ("rate", "int", 80, 450),
                     "--volume": ("volume", "float", 0.0, 1.0),
                     "--voice": ("voice", "text"),
                     "--pitch": ("pitch", "int", 0, 100)},
         "defaults": {"wait": False,
                      "timeout": None,
                      "feedback": False,
                      "preempt": None,
                      "flush": False,
                      "priority": 0,
                      "ttl": None,
                      "key": None,
                      "throttle": None,
                      "id": None,
                      "name": None,
                      "rate": None,
                      "volume": None,
                      "voice": None,
                      "pitch": None,
                      "lines": False,
                      "output": None},
         "environment": {"name": "TALK_NAME"}},
 "wait": {"argument": ("ids", -1),
          "options": {"-t": ("timeout", "float", 5e-324, None),
                      "--timeout": ("timeout", "float", 5e-324, None),
                      "-f": ("feedback", True),
                      "--feedback": ("feedback", True)},
          "defaults": {"timeout": None, "feedback": False},
          "environment": {}},
 "cancel": {"argument": ("ids", -1),
            "options": {"--current": ("current", True),
                        "--before": ("before", "text"),
                        "--key": ("key", "text")},
            "defaults": {"current": False, "before": None, "key": None},
            "environment": {}},
 "status": {"argument": ("goal_id", 1), "options": {}, "defaults": {}, "environment": {}},
 "log": {"argument": None,
         "options": {"-n": ("count", "int", 1, 1200), "--count": ("count", "int", 1, 1200)},
         "defaults": {"count": 20},
         "environment": {}},
 "voices": {"argument": None,
            "options": {"--language": ("language", "text")},
            "defaults": {"language": None},
            "environment": {}},
 "set": {"argument": None,
         "options": {"--rate": ("rate", "int", 80, 450),
                     "--volume": ("volume", "float", 0.0, 1.0),
                     "--voice": ("voice", "text"),
                     "--pitch": ("pitch", "int", 0, 100),
                     "--preempt": ("preempt", True),
                     "--no-preempt": ("preempt", False),
                     "--ttl": ("ttl", "float", 0, None)},
         "defaults": {"rate": None,
                      "volume": None,
                      "voice": None,
                      "pitch": None,
                      "preempt": None,
                      "ttl": None},
         "environment": {}},
 "pause": {"argument": None, "options": {}, "defaults": {}, "environment": {}},
 "resume": {"argument": None, "options": {}, "defaults": {}, "environment": {}}}
)
