"""`python -m wrt`: the command line."""

import sys

from wrt.core.errors import InputError
from wrt.core.packages import needed_by

try:
    with needed_by("the command line"):
        from wrt.cli.main import main
except InputError as error:
    print(f"error: {error}", file=sys.stderr)
    sys.exit(2)

main()
