"""`python -m wrt` and the script `wrt`: the command line."""

import sys

from wrt.core.errors import InputError
from wrt.core.packages import needed_by


def main() -> None:
    """Run the command line. Exit with code 2 and one message if click is missing."""
    try:
        with needed_by("the command line"):
            from wrt.cli.main import main as run
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    run()


if __name__ == "__main__":
    main()
