"""Random numbers for a wave's hits, many at a time (kernels.memory)."""

from typing import Any

import warp as wp

from wrt.kernels.loops.wave import Job, Wave
from wrt.kernels.loops.wave_rows import FACETS, KEYS, Key

store_key = KEYS.store()


@wp.func
def key_at(wave: Wave, job: Job, number: int) -> wp.uint32:
    """Of the samples of a path that has just been traced."""
    if job.fresh != 0:
        return wave.pixel_keys[number / job.samples]
    return wave.paths[wave.size[number] * wave.capacity + number].key


@wp.func
def put_keys(wave: Wave, first: int, end: int):
    """Put the keys of the hits first .. end - 1, at most BLOCK, to the rows KEYS."""
    job = wave.job[0]
    for j in range(first, end):
        number = wave.number[wave.met[j]]
        out = Key()
        out.key = key_at(wave, job, number)
        out.index = wp.uint32(job.first_sample + number % job.samples)
        store_key(wave.rows, j - first, out)


def make_sample_facets(choose_facet: Any) -> Any:
    """sample_facets(wave, count): put choose_facet (of make_step) of each hit of a block, whose keys are put, to FACETS."""
    load_key, store_facet = KEYS.load(), FACETS.store()

    @wp.func
    def sample_facets(wave: Wave, count: int):
        rows = wave.rows
        i = int(0)
        while i < count:
            at = load_key(rows, i)
            store_facet(rows, i, choose_facet(at.key, at.index))
            i = i + 1

    return sample_facets
