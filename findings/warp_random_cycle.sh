#!/usr/bin/env bash
# Library:  warp-lang 1.19.0 (NumPy 2.4.6).
# Expected: wp.rand_init(seed, tid) gives each thread a sequence of its own, as its docstring says ("avoids sharing the same sequence"), and a
#           sequence of randf does not repeat within a picture. The docstring names a PCG hash (Jarzynski and Olano, 2020).
# Seen:     the 32-bit hash is applied to its own result (native/rand.h), so every sequence walks a cycle of one fixed permutation of 2^32
#           values. Its shortest cycle has 4 values. With seed 308, thread 483,006 (pixel (1086, 251) of 1920x1080) draws the same four
#           numbers for ever; six more pixels of that picture repeat within 4,000 draws. Sequences also run into each other: with 500 draws
#           a pixel, 21.5 % of the pixels reach the first state of another pixel and then draw its numbers.
# Matters:  a Monte Carlo picture has pixels that no number of samples improves: the mean cosine of directions in the hemisphere is 0.237
#           there, not 0.5. Errors of pixels that share numbers are not independent, as denoisers and error estimates assume. No warning.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check warp-lang==1.19.0 numpy==2.4.6
export WARP_CACHE_PATH="$folder/cache"
cat > "$folder/seen.py" <<'PYTHON'
import numpy as np
import warp as wp

wp.config.quiet = True
SEED, PIXELS, BAD = 308, 1920 * 1080, 483006


@wp.kernel
def draw(seed: int, first: int, out: wp.array2d[float]):
    i = wp.tid()
    state = wp.rand_init(seed, first + i)
    for k in range(out.shape[1]):
        out[i, k] = wp.randf(state)


@wp.kernel
def mean_cosine(seed: int, first: int, samples: int, out: wp.array[wp.float64]):
    i = wp.tid()
    state = wp.rand_init(seed, first + i)
    total = wp.float64(0.0)
    for _ in range(samples):
        total += wp.float64(wp.sample_unit_hemisphere_surface(state)[2])
    out[i] = total / wp.float64(samples)


@wp.kernel
def period(seed: int, limit: int, out: wp.array[int]):
    i = wp.tid()
    state = wp.rand_init(seed, i)
    start = state
    for k in range(limit):
        if wp.randu(state) == start:
            out[i] = k + 1
            break


@wp.kernel
def starts(seed: int, bits: wp.array[wp.uint32]):
    state = wp.rand_init(seed, wp.tid())
    wp.atomic_or(bits, int(state >> wp.uint32(5)), wp.uint32(1) << (state & wp.uint32(31)))


@wp.kernel
def joins(seed: int, draws: int, bits: wp.array[wp.uint32], out: wp.array[int]):
    i = wp.tid()
    state = wp.rand_init(seed, i)
    start = state
    for _ in range(draws):
        value = wp.randu(state)
        if value != start and (bits[int(value >> wp.uint32(5))] >> (value & wp.uint32(31))) & wp.uint32(1) != wp.uint32(0):
            out[i] = 1
            break


numbers = wp.zeros((3, 12), dtype=float)
wp.launch(draw, 3, inputs=[SEED, BAD - 1, numbers])
numbers = numbers.numpy()
print("first numbers of pixels", BAD - 1, "to", BAD + 1)
print(np.round(numbers, 4))

cosines = wp.zeros(3, dtype=wp.float64)
wp.launch(mean_cosine, 3, inputs=[SEED, BAD - 1, 1 << 20, cosines])
cosines = cosines.numpy()
print("mean cosine of 1,048,576 directions (right: 0.5):", np.round(cosines, 4))

periods = wp.zeros(PIXELS, dtype=int)
wp.launch(period, PIXELS, inputs=[SEED, 4000, periods])
periods = periods.numpy()
short = np.flatnonzero(periods)
print("pixels that repeat within 4,000 draws:", dict(zip(short.tolist(), periods[short].tolist())))

bits = wp.zeros(1 << 27, dtype=wp.uint32)
shared = wp.zeros(PIXELS, dtype=int)
wp.launch(starts, PIXELS, inputs=[SEED, bits])
wp.launch(joins, PIXELS, inputs=[SEED, 500, bits, shared])
part = shared.numpy().mean()
print(f"pixels whose sequence of 500 draws joins that of another pixel: {part:.1%}")

assert (numbers[1].reshape(3, 4) == numbers[1, :4]).all() and (np.abs(numbers[1, :4] - [0.8302, 0.2848, 0.6954, 0.9149]) < 1e-4).all()
assert (np.abs(cosines[[0, 2]] - 0.5) < 0.002).all() and abs(cosines[1] - 0.2372) < 0.0002
assert dict(zip(short.tolist(), periods[short].tolist())) == {
    289095: 3666, 424098: 2915, 483006: 4, 626823: 3666, 1655171: 1611, 1776619: 1611, 1996773: 3442}
assert f"{part:.3f}" == "0.215"
PYTHON
"$folder/venv/bin/python" "$folder/seen.py"
