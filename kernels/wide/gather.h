    float numbers[sizeof(out) / sizeof(float)];
    for (unsigned k = 0; k < sizeof(out) / sizeof(float); ++k) numbers[k] = rows.data[(long long)i + WIDTH * k];
    memcpy(&out, numbers, sizeof(out));
