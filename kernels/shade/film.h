// The film: add_sample of film.py for LANES pixels at a time. The results have the same bits.
#pragma once
#include "layout.h"

namespace wrt {

template <class Film> void prefetch_pixels(const Film& film, const int* pixels) {
    for (int lane = 0; lane < LANES; ++lane) {
        const long long i = pixels[lane];
        __builtin_prefetch(film.mean.data + i, 1);
        __builtin_prefetch(film.m2.data + i, 1);
        __builtin_prefetch(film.lost.data + i, 1);
        __builtin_prefetch(film.samples.data + i, 1);
        __builtin_prefetch(film.rays.data + i, 1);
        __builtin_prefetch(film.cut_depth.data + i, 1);
        __builtin_prefetch(film.cut_throughput.data + i, 1);
        __builtin_prefetch(film.not_finite.data + i, 1);
    }
}

struct Pixels {
    float mean[3][LANES], m2[3][LANES], lost[LANES];
    long long rays[LANES];
    int samples[LANES], cut_depth[LANES], cut_throughput[LANES], not_finite[LANES];

    template <class Film> void load(const Film& film, const int* pixels) {
        for (int lane = 0; lane < LANES; ++lane) {
            const long long i = pixels[lane];
            for (int c = 0; c < 3; ++c) {
                mean[c][lane] = film.mean.data[i][c];
                m2[c][lane] = film.m2.data[i][c];
            }
            lost[lane] = film.lost.data[i];
            samples[lane] = film.samples.data[i];
            rays[lane] = cut_depth[lane] = cut_throughput[lane] = not_finite[lane] = 0;
        }
    }

    template <class Film> void store(const Film& film, const int* pixels) const {
        for (int lane = 0; lane < LANES; ++lane) {
            const long long i = pixels[lane];
            for (int c = 0; c < 3; ++c) {
                film.mean.data[i][c] = mean[c][lane];
                film.m2.data[i][c] = m2[c][lane];
            }
            film.lost.data[i] = lost[lane];
            film.samples.data[i] = samples[lane];
            film.rays.data[i] += rays[lane];
            film.cut_depth.data[i] += cut_depth[lane];
            film.cut_throughput.data[i] += cut_throughput[lane];
            film.not_finite.data[i] += not_finite[lane];
        }
    }
};

// Add `samples` samples to each of the LANES pixels of a Film at the indices `pixels`, in the samples' order. `done` holds the samples
// of the first pixel, then those of the second, and so on. The pixels at the next LANES indices are prefetched: these must be valid.
template <class Film, class Sample> void add_sample(const Film& film, const int* pixels, const Sample* done, int samples) {
    prefetch_pixels(film, pixels + LANES);
    Pixels sum;
    sum.load(film, pixels);
    // A table of the lanes' first samples: without it, the compiler vectorises the loop only for samples = 1.
    long long first[LANES];
    for (int lane = 0; lane < LANES; ++lane) first[lane] = (long long)lane * samples;
    for (int j = 0; j < samples; ++j)
#if defined(__clang__)
#pragma clang loop vectorize(assume_safety)
#endif
        for (int lane = 0; lane < LANES; ++lane) {
            const Sample& sample = done[first[lane] + j];
            const float total = sample.radiance[0] + sample.radiance[1] + sample.radiance[2];
            const bool finite = __builtin_fabsf(total) < __builtin_inff();
            sum.not_finite[lane] += finite ? 0 : 1;
            sum.samples[lane] += 1;
#if defined(__clang__)
#pragma unroll
#endif
            for (int c = 0; c < 3; ++c) {
                const float color = finite ? sample.radiance[c] : 0.0f;
                const float delta = color - sum.mean[c][lane];
                sum.mean[c][lane] = sum.mean[c][lane] + delta / (float)sum.samples[lane];
                sum.m2[c][lane] = sum.m2[c][lane] + delta * (color - sum.mean[c][lane]);
            }
            sum.rays[lane] += sample.rays;
            sum.cut_depth[lane] += sample.cut_depth;
            sum.cut_throughput[lane] += sample.cut_throughput;
            sum.lost[lane] += sample.lost;
        }
    sum.store(film, pixels);
}

}  // namespace wrt
