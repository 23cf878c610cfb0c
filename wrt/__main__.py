"""`python -m wrt`: the command line."""

from wrt.cli import main

main()
