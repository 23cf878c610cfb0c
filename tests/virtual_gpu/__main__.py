"""`python -m tests.virtual_gpu [--devices N] [--arch 75] [--seed N] ARGS...`: `python -m wrt ARGS...` with virtual GPUs."""

import argparse
import faulthandler
import sys

from tests.virtual_gpu import gpus, install, warp_private


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.virtual_gpu", description="wrt on virtual GPUs")
    parser.add_argument("--devices", type=int, default=2, help="how many")
    parser.add_argument("--arch", type=int, default=75, help="their compute capability, 75 for 7.5")
    parser.add_argument("--seed", type=int, default=0, help="of the order in which threads run")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="of wrt")
    given = parser.parse_args()
    faulthandler.enable()  # tells who touched the device's memory
    install(given.devices, given.arch, given.seed)
    from wrt.cli import main as wrt

    sys.argv[1:] = given.arguments
    try:
        wrt.main()
    finally:
        if warp_private.has_started():
            print(f"virtual GPU: {gpus().counts}", file=sys.stderr)


if __name__ == "__main__":
    main()
