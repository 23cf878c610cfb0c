// Vectorised shading with the headers of kernels/shade. Arrays have exactly the elements that the headers may access.
// tests/sanitize/shading.py writes the file of cases: the kind, the arguments, and the results of the scalar function.
#include "backgrounds.h"
#include "film.h"
#include "sampling.h"
#include "textures.h"

#include <cstdio>
#include <cstring>
#include <vector>

namespace {

using namespace wrt;

typedef std::vector<float> Floats;
typedef std::vector<int> Ints;

const int BLOCK = 64;

template <class T> struct Array {  // the interface of Warp's array that the headers use
    T* data;
};

struct Vec3 {
    float x[3];
    float& operator[](int k) { return x[k]; }
    float operator[](int k) const { return x[k]; }
};

struct Background {
    int width, height;
    float scale;
    Array<Vec3> pixels;
};

struct Texture {
    int first, width, height, srgb, wrap_u, wrap_v;
    Vec3 row_u, row_v, color_a, color_b;
};

struct Surfaces {
    Array<Texture> textures;
    Array<unsigned> texels;
    Array<float> srgb_to_linear;
};

struct Sample {
    Vec3 radiance;
    int rays, cut_depth, cut_throughput;
    float lost;
};

struct Film {
    Array<Vec3> mean, m2;
    Array<int> samples;
    Array<long long> rays;
    Array<int> cut_depth, cut_throughput;
    Array<float> lost;
    Array<int> not_finite;
};

template <class T> std::vector<T> next(FILE* file) {
    int bytes = 0;
    if (fread(&bytes, sizeof(bytes), 1, file) != 1) return {};
    std::vector<T> out(bytes / sizeof(T));
    if (bytes && fread(out.data(), 1, bytes, file) != (size_t)bytes) return {};
    return out;
}

size_t whole(size_t n) { return (n + LANES - 1) / LANES * LANES; }

bool same(const void* a, const void* b, size_t bytes) { return bytes == 0 || !memcmp(a, b, bytes); }

bool points(FILE* file) {
    const Ints given = next<int>(file);
    const Floats expected = next<float>(file);
    Floats out(2 * whole(given[2]));
    sample_2d((unsigned)given[0], (unsigned)given[1], given[2], out.data());
    return same(out.data(), expected.data(), 4 * expected.size());
}

bool quantiles(FILE* file) {
    const Floats icdf = next<float>(file);
    Floats values = next<float>(file);
    const Floats expected = next<float>(file);
    quantile(icdf.data(), (int)icdf.size(), values.data(), (int)values.size());
    return same(values.data(), expected.data(), 4 * expected.size());
}

bool sky(FILE* file) {
    const Ints size = next<int>(file);
    const Floats scale = next<float>(file);
    std::vector<Vec3> pixels = next<Vec3>(file);
    Floats x = next<float>(file), y = next<float>(file);
    const Floats red = next<float>(file), green = next<float>(file), blue = next<float>(file);
    const size_t n = x.size();
    x.resize(whole(n), __builtin_nanf("")), y.resize(whole(n), 3e38f);  // lanes without a sample may have any values
    Floats z(whole(n));
    environment_at(Background{size[0], size[1], scale[0], {pixels.data()}}, x.data(), y.data(), z.data(), (int)n);
    return same(x.data(), red.data(), 4 * n) && same(y.data(), green.data(), 4 * n) && same(z.data(), blue.data(), 4 * n);
}

bool texels(FILE* file) {
    std::vector<Texture> textures = next<Texture>(file);
    std::vector<unsigned> all = next<unsigned>(file);
    Floats table = next<float>(file);
    const Ints wanted = next<int>(file), size_and_mask = next<int>(file);
    const Floats us = next<float>(file), vs = next<float>(file), expected = next<float>(file);  // expected: a row per channel
    const size_t n = size_and_mask[0], rows = expected.size() / n;
    Floats out(rows * BLOCK);
    sample_texture<BLOCK>(Surfaces{{textures.data()}, {all.data()}, {table.data()}}, wanted.data(), us.data(), vs.data(), (int)n,
                          size_and_mask[1], out.data());
    bool right = true;
    for (size_t row = 0; row < rows; ++row)
        for (size_t i = 0; i < n; ++i) {
            const float a = out[row * BLOCK + i], b = expected[row * n + i];
            right = right && (same(&a, &b, 4) || (a != a && b != b));
        }
    return right;
}

bool pixels(FILE* file) {
    const Ints order = next<int>(file), n = next<int>(file);
    const std::vector<Sample> done = next<Sample>(file);
    std::vector<Vec3> mean(n[0]), m2(n[0]);
    Ints samples(n[0]), cut_depth(n[0]), cut_throughput(n[0]), not_finite(n[0]);
    std::vector<long long> rays(n[0]);
    Floats lost(n[0]);
    const Film film = {{mean.data()}, {m2.data()}, {samples.data()}, {rays.data()}, {cut_depth.data()}, {cut_throughput.data()},
                       {lost.data()}, {not_finite.data()}};
    add_sample(film, order.data(), done.data(), (int)done.size() / LANES);
    const auto as_expected = [&](const void* found, size_t bytes) {
        const std::vector<char> expected = next<char>(file);
        return expected.size() == bytes && same(found, expected.data(), bytes);
    };
    return as_expected(mean.data(), 12 * mean.size()) && as_expected(m2.data(), 12 * m2.size())
           && as_expected(samples.data(), 4 * samples.size()) && as_expected(rays.data(), 8 * rays.size())
           && as_expected(cut_depth.data(), 4 * cut_depth.size()) && as_expected(cut_throughput.data(), 4 * cut_throughput.size())
           && as_expected(lost.data(), 4 * lost.size()) && as_expected(not_finite.data(), 4 * not_finite.size());
}

}  // namespace

int main(int, char** arguments) {
    FILE* const file = fopen(arguments[1], "rb");
    if (!file) return 2;
    bool (*const kinds[])(FILE*) = {points, quantiles, sky, texels, pixels};
    const char* const names[] = {"sample_2d", "quantile", "environment_at", "sample_texture", "add_sample"};
    int cases = 0, wrong = 0;
    for (Ints kind = next<int>(file); !kind.empty(); kind = next<int>(file), ++cases)
        if (!kinds[kind[0]](file)) {
            printf("case %d, %s: not as its scalar twin\n", cases, names[kind[0]]);
            ++wrong;
        }
    fclose(file);
    printf("%d cases, %d wrong\n", cases, wrong);
    return cases == 0 || wrong != 0;
}
