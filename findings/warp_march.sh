#!/usr/bin/env bash
# Library:  warp-lang 1.19.0 (NumPy 2.4.6), on a CPU with AVX2.
# Expected: wp.config.cpu_compiler_flags takes "-march=native, Clang frontend flags, and LLVM arguments" (its docstring), so that
#           "-march=x86-64-v3" compiles kernels for every processor of a cluster, as it does in Clang.
# Seen:     "-march=native" is taken, but "-march=x86-64-v3" is an unknown argument: the launch fails with "CPU kernel build failed with error
#           code -1", and only a line on stderr names the flag. "-target-cpu x86-64-v3", the name inside of Clang, is taken.
# Matters:  by default, kernels are compiled for the processor at hand. Whoever wants the same machine code on several machines, as in a
#           render on a cluster, must know the inner name of the option; the exception sends him to the kernel instead.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check warp-lang==1.19.0 numpy==2.4.6
cat > "$folder/seen.py" <<'PYTHON'
import sys

import warp as wp

wp.config.quiet, wp.config.cpu_compiler_flags = True, sys.argv[1]


@wp.kernel
def scale(x: wp.array[float], y: wp.array[float]):
    i = wp.tid()
    y[i] = 3.0 * x[i]


x = wp.full(1000, 2.0, dtype=float, device="cpu")
y = wp.empty_like(x)
try:
    wp.launch(scale, 1000, [x, y], device="cpu")
    print("compiled, y =", y.numpy()[0])
except Exception as error:
    print("refused:", type(error).__name__, error)
PYTHON
for flags in "-march=native" "-march=x86-64-v3" "-target-cpu x86-64-v3"; do
    echo "$flags: $(WARP_CACHE_PATH="$folder/cache$RANDOM" "$folder/venv/bin/python" "$folder/seen.py" "$flags" 2> "$folder/errors" | tail -1)"
    grep -h "unknown argument" "$folder/errors" | sort -u || true
done | tee "$folder/seen"
diff - "$folder/seen" <<'SEEN'
-march=native: compiled, y = 6.0
-march=x86-64-v3: refused: Exception CPU kernel build failed with error code -1
error: unknown argument: '-march=x86-64-v3'
-target-cpu x86-64-v3: compiled, y = 6.0
SEEN
echo "as noted"
