    // As render.with_sample, for LANES pixels at a time, whose samples stand one after another: a loop over pixels that the compiler
    // makes lanes of. Each pixel takes its samples in their order.
    const int* const at = pixels.data + (long long)p;
    for (int lane = 0; lane < LANES; ++lane) {  // the next ones are called in; behind the last, what was there before
        const long long i = at[LANES + lane];
        __builtin_prefetch(film.mean.data + i, 1);
        __builtin_prefetch(film.m2.data + i, 1);
        __builtin_prefetch(film.lost.data + i, 1);
        __builtin_prefetch(film.samples.data + i, 1);
        __builtin_prefetch(film.rays.data + i, 1);
        __builtin_prefetch(film.cut_depth.data + i, 1);
        __builtin_prefetch(film.cut_throughput.data + i, 1);
        __builtin_prefetch(film.not_finite.data + i, 1);
    }
    struct Pixels {
        float mean[3][LANES], m2[3][LANES], lost[LANES];
        long long rays[LANES];
        int samples[LANES], cut_depth[LANES], cut_throughput[LANES], not_finite[LANES];
    } sum;
    for (int lane = 0; lane < LANES; ++lane) {
        const long long i = at[lane];
        for (int c = 0; c < 3; ++c) {
            sum.mean[c][lane] = film.mean.data[i][c];
            sum.m2[c][lane] = film.m2.data[i][c];
        }
        sum.lost[lane] = film.lost.data[i];
        sum.samples[lane] = film.samples.data[i];
        sum.rays[lane] = sum.cut_depth[lane] = sum.cut_throughput[lane] = sum.not_finite[lane] = 0;
    }
    // Places by table: of a multiple of `samples` the compiler makes lanes for samples = 1 alone.
    long long first[LANES];
    for (int lane = 0; lane < LANES; ++lane)
        first[lane] = ((long long)p + lane) * samples;
    for (int j = 0; j < samples; ++j)
        #pragma clang loop vectorize(assume_safety)
        for (int lane = 0; lane < LANES; ++lane) {
            const auto& sample = done.data[first[lane] + j];
            const float total = sample.radiance[0] + sample.radiance[1] + sample.radiance[2];
            const bool finite = __builtin_fabsf(total) < __builtin_inff();
            sum.not_finite[lane] += finite ? 0 : 1;
            sum.samples[lane] += 1;
            #pragma unroll
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
    for (int lane = 0; lane < LANES; ++lane) {
        const long long i = at[lane];
        for (int c = 0; c < 3; ++c) {
            film.mean.data[i][c] = sum.mean[c][lane];
            film.m2.data[i][c] = sum.m2[c][lane];
        }
        film.lost.data[i] = sum.lost[lane];
        film.samples.data[i] = sum.samples[lane];
        film.rays.data[i] += sum.rays[lane];
        film.cut_depth.data[i] += sum.cut_depth[lane];
        film.cut_throughput.data[i] += sum.cut_throughput[lane];
        film.not_finite.data[i] += sum.not_finite[lane];
    }
