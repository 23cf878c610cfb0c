// Lanes: numbers side by side, on all of which one instruction works. Vectors are an extension of GCC and Clang: they name no
// instruction set, and run on every CPU.
#pragma once
#define WRT_INLINE static inline __attribute__((always_inline))
#define WRT_MEMBER inline __attribute__((always_inline))
#define WRT_CALLED static __attribute__((noinline))  // else the compiler copies it to where it is called

namespace wrt {

// Integers are as long as floats: a comparison of floats gives integers, -1 or 0, and chooses between integers too.
template <int N> struct Lanes {
    typedef float Floats __attribute__((vector_size(4 * N)));
    typedef int Ints __attribute__((vector_size(4 * N)));
    typedef unsigned Keys __attribute__((vector_size(4 * N)));
    typedef double Doubles __attribute__((vector_size(8 * N)));
};

template <class V> constexpr int lanes_of = sizeof(V) / sizeof(V{}[0]);

// Memory need not be aligned.
template <class V> WRT_INLINE V load(const void* from) {
    V out;
    __builtin_memcpy(&out, from, sizeof(out));
    return out;
}

template <class V> WRT_INLINE void store(void* to, V value) { __builtin_memcpy(to, &value, sizeof(value)); }

// A number in all lanes; what is lanes already stays as it is.
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

// The mask, a bit a lane, of the lanes of a comparison that hold.
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

// And back: a comparison that holds in the lanes of a mask.
template <class Ints> WRT_INLINE Ints in_mask(int mask) {
    Ints lane;
    for (int k = 0; k < lanes_of<Ints>; ++k) lane[k] = k;
    return (all<Ints>(mask) >> lane & 1) != 0;
}

WRT_INLINE int lowest(unsigned mask) { return __builtin_ctz(mask); }

// For a condition that is as often true as not.
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
