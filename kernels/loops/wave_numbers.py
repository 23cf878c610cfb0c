"""Keys and random numbers for a wave's hits, in vectorised loops."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import Wave
from wrt.kernels.loops.wave_rows import FACETS, KEYS, Key
from wrt.kernels.structs import noinline

store_key = KEYS.store()


@wp.func
def key_at(wave: Wave, s: int) -> wp.uint32:
    """Return Path.key, a seed, of the path of sample s whose ray has just been traced."""
    if wave.progress[0].fresh != 0:
        return wave.pixels.key[s / wave.task[0].samples]
    return wave.samples.paths[wave.samples.pending[s] * wave.capacity + s].key


@noinline
def store_keys(wave: Wave, first: int, end: int):
    """Store the keys of the hits first .. end - 1, at most BLOCK, in the rows KEYS."""
    task = wave.task[0]
    for j in range(first, end):
        s = wave.queue.sample[wave.outcomes.hit_rays[j]]
        out = Key()
        out.key = key_at(wave, s)
        out.index = wp.uint32(task.first_sample + s % task.samples)
        store_key(wave.block.rows, j - first, out)


def make_sample_facets(choose_facet: Any) -> Any:
    """Return sample_facets(wave, count): store the results of choose_facet for `count` hits in the rows FACETS."""
    load_key, store_facet = KEYS.load(), FACETS.store()

    @noinline
    def sample_facets(wave: Wave, count: int):
        rows = wave.block.rows
        i = int(0)
        while i < count:
            at = load_key(rows, i)
            store_facet(rows, i, choose_facet(at.key, at.index))
            i = i + 1

    return sample_facets
