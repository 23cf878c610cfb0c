"""Random numbers for a wave's hits, many at a time (kernels.memory)."""

from typing import Any

import warp as wp

from wrt.kernels.loops.wave import Job, Wave
from wrt.kernels.loops.wave_surfaces import ROW, put_row_vec3
from wrt.kernels.memory import bits_at


@wp.func
def key_at(wave: Wave, job: Job, number: int) -> wp.uint32:
    """Of the samples of a path that has just been traced."""
    if job.fresh != 0:
        return wave.pixel_keys[number / job.samples]
    return wave.paths[wave.size[number] * wave.capacity + number].key


@wp.func
def put_keys(wave: Wave, first: int, end: int):
    """To wave.keys and wave.indices, what the numbers of the hits first .. end - 1, at most BLOCK, are made from."""
    job = wave.job[0]
    for j in range(first, end):
        number = wave.number[wave.met[j]]
        wave.keys[j - first] = key_at(wave, job, number)
        wave.indices[j - first] = wp.uint32(job.first_sample + number % job.samples)


def make_sample_facets(choose_facet: Any) -> Any:
    """sample_facets(wave, count): to the row facet, choose_facet (of make_step) for each hit of a block whose keys are put."""
    @wp.func
    def sample_facets(wave: Wave, count: int):
        i = int(0)
        while i < count:
            put_row_vec3(wave.rows, wp.static(ROW["facet"]), i, choose_facet(bits_at(wave.keys, i), bits_at(wave.indices, i)))
            i = i + 1

    return sample_facets
