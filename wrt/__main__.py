"""`python -m wrt`: the command line."""

from wrt.cli.main import main

main()
