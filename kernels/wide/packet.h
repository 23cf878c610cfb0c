    // Sixteen rays side by side: `row(NAME)` is one number of each of them (packets.py: ROWS); q: where they begin.
    static_assert(LANES == 16, "masks of rays are 16 bits");
    typedef float Rays __attribute__((ext_vector_type(LANES), aligned(4)));
    typedef int RayInts __attribute__((ext_vector_type(LANES), aligned(4)));
    typedef bool RayBools __attribute__((ext_vector_type(LANES)));
    #define RAY_MASK(x) (int)__builtin_bit_cast(unsigned short, __builtin_convertvector((x), RayBools))
    const RayInts lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    #define IN(mask) ((((mask) >> lane) & 1) != 0)
    auto row = [q](int k) -> Rays& { return *(Rays*)(q + k); };
    auto int_row = [q](int k) -> RayInts& { return *(RayInts*)(q + k); };
