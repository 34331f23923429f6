"""Entry point for `python -m talkcli`."""

from talkcli.cli import main

main()
