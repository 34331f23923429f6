"""Goals, events and settings as text for a terminal.

This package is pure: objects go in and lines come out. It prints nothing, and the caller passes the width of the
terminal and the time. It may import `protocol`, `goals` and the modules of `talkcli` itself. This package decides how
things look, and the command line decides when they are shown.
"""
