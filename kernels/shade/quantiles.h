    // As sampling.quantile, for both numbers of many points: a loop that the compiler makes lanes of. It cannot tell where the table
    // ends, so results go to `out` first: they cannot overwrite it.
    float* const values = (float*)(points.data + (long long)first);
    const int size = icdf.shape[0];
    for (int j = 0; j < 2 * count; j += LANES) {
        const int n = 2 * count - j < LANES ? 2 * count - j : LANES;
        float in[LANES] = {}, out[LANES];
        memcpy(in, values + j, sizeof(float) * n);
        for (int lane = 0; lane < LANES; ++lane) {
            const float position = in[lane] * (float)(size - 1);
            const int whole = (int)position, i = whole < size - 2 ? whole : size - 2;
            const float t = position - (float)i;
            out[lane] = icdf.data[i] * (1.0f - t) + icdf.data[i + 1] * t;
        }
        memcpy(values + j, out, sizeof(float) * n);
    }
