    // As sampling.sample_2d, one number after another of a pixel's sequence: a loop that the compiler makes lanes of.
    struct Hashes {
        static unsigned hash(unsigned x) {
            x ^= x >> 16; x *= HASH_1; x ^= x >> 15; x *= HASH_2;
            return x ^ (x >> 15);
        }
        static unsigned scramble(unsigned x, unsigned seed) {
            x ^= x * LK_1; x += seed; x *= (seed >> 16) | 1; x ^= x * LK_2;
            return x ^ (x * LK_3);
        }
        static unsigned second(unsigned x) {
            x ^= (x >> 1) & BITS_1; x ^= (x >> 2) & BITS_2; x ^= (x >> 4) & BITS_4; x ^= (x >> 8) & BITS_8;
            return x ^ (x >> 16);
        }
    };
    const unsigned seed_x = Hashes::hash(seed ^ SEED_X), seed_y = Hashes::hash(seed ^ SEED_Y);
    float* to = (float*)(out.data + (long long)at);
    // Sixteen at a time, also where fewer are left: the others are computed and written in vain.
    for (int j = 0; j < count; j += LANES) {
        float points[2 * LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const unsigned i = __builtin_bitreverse32(Hashes::scramble(__builtin_bitreverse32((unsigned)first + j + lane), seed));
            const unsigned x = __builtin_bitreverse32(Hashes::scramble(i, seed_x));
            const unsigned y = __builtin_bitreverse32(Hashes::scramble(Hashes::second(i), seed_y));
            points[2 * lane] = (float)(x >> 8) * UNIT;
            points[2 * lane + 1] = (float)(y >> 8) * UNIT;
        }
        memcpy(to + 2 * j, points, sizeof(points));
    }
