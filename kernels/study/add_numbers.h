    float numbers[sizeof(record) / sizeof(float)];
    memcpy(numbers, &record, sizeof(record));
    for (unsigned k = 0; k < sizeof(record) / sizeof(float); ++k) {
        if (k != PRIM_ID) total += numbers[k];
    }
    return total;
