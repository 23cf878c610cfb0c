// The traversals of kernels/wide/batch.py in C++, with the headers of kernels/wide. Arrays have exactly the elements that the headers
// may access. tests/sanitize/cases.py writes the file of cases.
#include "interleaved.h"
#include "set_up.h"

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

namespace {

using namespace wrt;

const int EMPTY = 0;

template <class T> struct Array {  // the interface of Warp's array that the headers use
    T* data;
    int strides[1];
};

struct Vector {
    float x, y, z;
};

struct RayArrays {
    Array<Vector> origin, direction;
    Array<float> t_min, t_max;
};

struct HitArrays {
    Array<float> t, u, v;
    Array<int> prim_id;
};

struct Hit {
    float t, u, v;
    int prim_id;
};

struct HitLists {
    bool crossings;
    Array<int> first;
    Array<Hit> rows;
};

struct Case {
    std::vector<float> nodes, primitives;  // of a BVH with 8 children per node
    std::vector<float> origins, directions, t_mins, t_maxs;
    std::vector<int> excludes;
    std::vector<float> t, u, v;  // the hits by the kernel for one ray
    std::vector<int> prim_id, occluded, crossings, hits;
    int rays;
};

int leaf_first(int reference) { return (-1 - reference) >> LEAF_BITS; }
int leaf_count(int reference) { return ((-1 - reference) & ((1 << LEAF_BITS) - 1)) + 1; }

template <int GOAL> class Walk {
public:
    explicit Walk(Case& c, HitLists out = {}) : given(c), lists(out), packet(PACKET_SIZE), stack(STACK_WORDS), slot(SLOT_SIZE) {}

    // Trace the rays first .. first + count - 1: as one packet if `together` and their bounds form a beam, else one by one.
    void trace(int first, int count, bool together) {
        RayArrays rays = {{(Vector*)given.origins.data(), {12}}, {(Vector*)given.directions.data(), {12}},
                          {given.t_mins.data(), {given.t_mins.size() == 1 ? 0 : 4}}, {given.t_maxs.data(), {4}}};
        const int state = set_up<true, UNORDERED>(pointers_to(rays, first, given.excludes.data() + first), count, FAR, true, packet.data());
        if (GOAL == LIST_ALL) begin_lists(first, packet.data());
        if (state >= COHERENT && together) {
            walk_packet(state);
        } else {
            int alone = rays_meeting_root(given.nodes.data(), state & (COHERENT - 1), packet.data());
            for (; alone; alone &= alone - 1) walk_alone(lowest(alone));
        }
    }

    void write(HitArrays hits, int first, int count) { write_hits(hits, first, count, packet.data()); }
    void write(bool* occluded, int count) { write_occluded(occluded, count, packet.data()); }
    void write(int* listed, int count) { memcpy(listed, packet.data() + LISTED, count * sizeof(int)); }

private:
    static constexpr bool UNORDERED = GOAL != FIND_CLOSEST;
    static constexpr float FAR = Bounds::FAR_PAD * (1.0f + 8.0f / (1 << 24));  // lanes.py: LANE_PAD

    void walk_packet(int state) {
        const auto push_children = state >= MIXED ? children<UNORDERED, UNORDERED> : children<UNORDERED, false>;
        int size = 0, reference = 0, mask = state & (COHERENT - 1);
        for (;;) {
            if (reference < 0) {
                leaf_of_packet(reference, mask);
            } else {
                size = push_children(given.nodes.data(), given.primitives.data(), packet.data(), reference, mask, stack.data(), size);
            }
            unsigned long long key = 0;
            for (mask = 0; size > 0 && mask == 0;) {
                const unsigned* entry = stack.data() + ENTRY * --size;
                key = load<unsigned long long>(entry);
                mask = (int)entry[ENTRY_RAYS] & rays_reaching(__builtin_bit_cast(float, (unsigned)(key >> 32)), packet.data());
            }
            if (mask == 0) return;
            reference = (int)(unsigned)key;
        }
    }

    void leaf_of_packet(int reference, int mask) {
        const float* row = given.primitives.data() + leaf_first(reference) * ROW_SIZE;
        for (int left = leaf_count(reference); left > 0; left -= WIDTH, row += ROW_SIZE) {
            const int n = left < WIDTH ? left : WIDTH;
            if (mask & 1) {  // cover both forms: rays in lanes, and ray by ray
                mask &= ~(triangles<GOAL>(row, n, mask, packet.data(), lists) & (GOAL == FIND_ANY ? ~0 : 0));
            } else {
                for (int rays = mask; rays; rays &= rays - 1)
                    ray_triangles<GOAL>(row, (2 << (n - 1)) - 1, packet.data() + lowest(rays), lists);
            }
        }
    }

    void walk_alone(int ray) {
        int next = begin<UNORDERED>(given.nodes.data(), 0, packet.data(), ray, stack.data(), 0, slot.data());
        while (next != EMPTY) {
            prefetch(given.nodes.data(), given.primitives.data(), next);
            if (next > 0) {
                next = step<UNORDERED>(given.nodes.data(), packet.data(), stack.data(), 0, slot.data());
                continue;
            }
            const float* row = given.primitives.data() + leaf_first(next) * ROW_SIZE;
            for (int left = leaf_count(next); left > 0; left -= WIDTH, row += ROW_SIZE) {
                const int n = left < WIDTH ? left : WIDTH;
                const int lane = ray_triangles_here<GOAL>(row, (2 << (n - 1)) - 1, packet.data() + ray, lists);
                if (GOAL == FIND_ANY && lane >= 0) return;
            }
            next = pop<UNORDERED>(given.nodes.data(), packet[ray + T], stack.data(), 0, slot.data());
        }
    }

    Case& given;
    HitLists lists;
    std::vector<float> packet;
    std::vector<unsigned> stack;
    std::vector<int> slot;
};

// Return whether all rays of a case have the expected hits, traced in packets of at most `most` rays.
bool agrees(Case& c, int most, bool together) {
    std::vector<float> t(c.rays), u(c.rays), v(c.rays);
    std::vector<int> prim_id(c.rays);
    std::vector<int> crossings(c.rays), hits(c.rays), no_room(c.rays + 1), first_row(c.rays + 1);
    for (int i = 0; i <= c.rays; ++i) first_row[i] = 2 * i;
    std::vector<Hit> rows(2 * c.rays);
    bool* const occluded = new bool[c.rays];
    Walk<FIND_CLOSEST> closest(c);
    Walk<FIND_ANY> any(c);
    Walk<LIST_ALL> crossed(c, {true, {no_room.data(), {4}}, {nullptr, {16}}}), all(c, {false, {first_row.data(), {4}}, {rows.data(), {16}}});
    for (int first = 0; first < c.rays; first += most) {
        const int count = c.rays - first < most ? c.rays - first : most;
        closest.trace(first, count, together);
        closest.write({{t.data(), {4}}, {u.data(), {4}}, {v.data(), {4}}, {prim_id.data(), {4}}}, first, count);
        any.trace(first, count, together);
        any.write(occluded + first, count);
        crossed.trace(first, count, together);
        crossed.write(crossings.data() + first, count);
        all.trace(first, count, together);
        all.write(hits.data() + first, count);
    }
    int wrong = 0;
    for (int i = 0; i < c.rays; ++i) {
        const bool same = !memcmp(&t[i], &c.t[i], 4) && !memcmp(&u[i], &c.u[i], 4) && !memcmp(&v[i], &c.v[i], 4)
                          && prim_id[i] == c.prim_id[i] && occluded[i] == (c.occluded[i] != 0)
                          && crossings[i] == c.crossings[i] && hits[i] == c.hits[i];
        if (!same && wrong++ < 3)
            printf("    ray %d: triangle %d at %.9g, any %d, %d of %d hits; one ray at a time: %d at %.9g, any %d, %d of %d hits\n", i,
                   prim_id[i], t[i], occluded[i], crossings[i], hits[i], c.prim_id[i], c.t[i], c.occluded[i],
                   c.crossings[i], c.hits[i]);
    }
    delete[] occluded;
    return wrong == 0;
}

template <class T> bool read(FILE* file, std::vector<T>& out) {
    int n;
    if (fread(&n, sizeof(n), 1, file) != 1) return false;
    out.resize(n);
    return n == 0 || fread(out.data(), sizeof(T), n, file) == (size_t)n;
}

}  // namespace

int main(int, char** arguments) {
    FILE* const file = fopen(arguments[1], "rb");
    if (!file) return 2;
    Case c;
    int cases = 0, wrong = 0;
    for (; read(file, c.nodes); ++cases) {
        if (!(read(file, c.primitives) && read(file, c.origins) && read(file, c.directions) && read(file, c.t_mins)
              && read(file, c.t_maxs) && read(file, c.excludes) && read(file, c.t) && read(file, c.u) && read(file, c.v)
              && read(file, c.prim_id) && read(file, c.occluded)
              && read(file, c.crossings) && read(file, c.hits)))
            return 2;
        c.rays = (int)c.excludes.size();
        for (int most : {LANES, 7, 1})
            for (bool together : {true, false})
                if (!agrees(c, most, together)) {
                    printf("case %d, %d rays at a time: wrong\n", cases, most);
                    ++wrong;
                }
    }
    fclose(file);
    printf("%d cases, %d wrong\n", cases, wrong);
    return wrong != 0;
}
