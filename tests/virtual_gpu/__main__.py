"""Run `python -m wrt ARGS...` with virtual GPUs: `python -m tests.virtual_gpu [--devices N] [--arch 75] [--seed N] ARGS...`."""

import argparse
import faulthandler
import sys

from tests.virtual_gpu import gpus, install, warp_private


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.virtual_gpu", description="wrt on virtual GPUs")
    parser.add_argument("--devices", type=int, default=2, help="number of GPUs")
    parser.add_argument("--arch", type=int, default=75, help="compute capability of the GPUs, 75 for 7.5")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random order in which threads run")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="arguments of wrt")
    options = parser.parse_args()
    faulthandler.enable()  # prints the code that touched the device's memory
    install(options.devices, options.arch, options.seed)
    from wrt.cli import main as wrt

    sys.argv[1:] = options.arguments
    try:
        wrt.main()
    finally:
        if warp_private.has_started():
            print(f"virtual GPU: {gpus().counts}", file=sys.stderr)


if __name__ == "__main__":
    main()
