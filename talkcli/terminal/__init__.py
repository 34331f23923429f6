"""Code that formats goals, events and settings as text for a terminal.

This package takes objects and returns lines. It prints nothing, and the caller passes the width of the terminal and the
time. It may import `protocol`, `goals` and the modules directly in `talkcli`. This package decides how things look, and
the command line decides when they are shown.
"""
