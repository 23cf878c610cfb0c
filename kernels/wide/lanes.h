// Vectors whose lanes one instruction processes. They are an extension of GCC and Clang: the compiler chooses the instructions, so that the
// code runs on every CPU.
#pragma once
#define WRT_INLINE static inline __attribute__((always_inline))
#define WRT_MEMBER inline __attribute__((always_inline))
#define WRT_CALLED static __attribute__((noinline))  // For large functions, which the compiler would inline at each call.
#if defined(WRT_CHECK)  // a flag of debugging builds and of tests/sanitize
#define WRT_ASSERT(condition) ((condition) ? (void)0 : __builtin_trap())
#else
#define WRT_ASSERT(condition) ((void)0)
#endif

namespace wrt {

// Vectors of N lanes. A comparison of Floats returns Ints, -1 or 0 in each lane, which the operator ?: accepts to select lanes.
template <int N> struct Lanes {
    typedef float Floats __attribute__((vector_size(4 * N)));
    typedef int Ints __attribute__((vector_size(4 * N)));
    typedef unsigned Keys __attribute__((vector_size(4 * N)));
    typedef double Doubles __attribute__((vector_size(8 * N)));
};

// Lanes of one register.
#if defined(__AVX512F__)
constexpr int REGISTER = 16;
#elif defined(__AVX__)
constexpr int REGISTER = 8;
#else
constexpr int REGISTER = 4;
#endif

template <class V> constexpr int lanes_of = sizeof(V) / sizeof(V{}[0]);

// Load from memory that need not be aligned.
template <class V> WRT_INLINE V load(const void* from) {
    V out;
    __builtin_memcpy(&out, from, sizeof(out));
    return out;
}

template <class V> WRT_INLINE void store(void* to, V value) { __builtin_memcpy(to, &value, sizeof(value)); }

// Return a vector with the number x in all lanes; if x is a vector, return x.
template <class V, class Number> WRT_INLINE V all(Number x) { return x - V{}; }

template <class V> WRT_INLINE V absolute(V x) {
#if defined(__clang__)
    return __builtin_elementwise_abs(x);
#else
    for (int k = 0; k < lanes_of<V>; ++k) x[k] = __builtin_fabsf(x[k]);
    return x;
#endif
}

template <class V> WRT_INLINE auto least_of(V x) {
#if defined(__clang__)
    return __builtin_reduce_min(x);
#else
    auto out = x[0];
    for (int k = 1; k < lanes_of<V>; ++k) out = x[k] < out ? x[k] : out;
    return out;
#endif
}

// Return a comparison's result as a mask: bit k is set if the comparison holds in lane k.
template <class V> WRT_INLINE int mask_of(V holds) {
    constexpr int N = lanes_of<V>;
#if defined(__clang__)
    typedef bool Bools __attribute__((ext_vector_type(N)));
    if constexpr (N == 16)
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(holds, Bools));
    else
        return __builtin_bit_cast(unsigned char, __builtin_convertvector(holds, Bools)) & ((1 << N) - 1);
#else
    int out = 0;
    for (int k = 0; k < N; ++k) out |= (holds[k] != 0) << k;
    return out;
#endif
}

// Return a mask as a comparison's result: -1 in the lanes whose bit is set, else 0.
template <class Ints> WRT_INLINE Ints in_mask(int mask) {
    Ints lane;
    for (int k = 0; k < lanes_of<Ints>; ++k) lane[k] = k;
    return (all<Ints>(mask) >> lane & 1) != 0;
}

// Return the index of the lowest bit set in a mask. It must not be 0: the result would depend on the processor.
WRT_INLINE int lowest(unsigned mask) {
    WRT_ASSERT(mask != 0);
    return __builtin_ctz(mask);
}

// Return the pointer, of which the compiler then does not know that it stays the same in a loop. What is read through it is an operand in
// memory, where a copy in a register would push others out.
template <class T> WRT_INLINE T* opaque(T* pointer) {
    __asm__("" : "+r"(pointer));
    return pointer;
}

// Tell the compiler that a condition is true about half the time, so that it avoids a branch.
#if defined(__clang__)
#define WRT_UNPREDICTABLE(condition) __builtin_unpredictable(condition)
#else
#define WRT_UNPREDICTABLE(condition) (condition)
#endif

template <class T> struct Vec3 {
    T at[3];
    WRT_MEMBER T& operator[](int k) { return at[k]; }
    WRT_MEMBER const T& operator[](int k) const { return at[k]; }
};

}  // namespace wrt
