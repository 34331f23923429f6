"""The command `talk`, run as `python -m talkcli`."""

from talkcli.cli import main

main()
