"""`python -m talkcli`: the command `talk`, where it isn't on the PATH."""

from talkcli.cli import main

main()
