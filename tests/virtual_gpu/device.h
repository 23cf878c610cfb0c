// This text is inserted between Warp's headers, which are compiled as for the CPU, and the code of a CUDA module. It defines CUDA's
// built-in names, and a loop over the threads of a grid. A module is loaded for one device, which runs one launch at a time and one
// thread after another: so static variables are enough for threadIdx and the like, and Warp's atomic functions for the CPU are
// atomic. Operations of a block (__syncthreads, shuffles, votes, tiles) are missing: a module with one does not compile.

#undef WP_TILE_BLOCK_DIM
#define WP_TILE_BLOCK_DIM MODULE_BLOCK_DIM
#define __CUDA_ARCH__ MODULE_ARCH

#define __global__
#define __device__
#define __shared__ static  // threads run one after another: each reads the values that it wrote
#define __forceinline__ inline
#define __launch_bounds__(...)

struct uint3 {
    unsigned x, y, z;
};

static uint3 threadIdx, blockIdx, blockDim, gridDim;

namespace wp {
inline int device_block_dim() { return ::blockDim.x; }
}
#define block_dim device_block_dim

// CUDA functions that kernels call. Kernels call `atomicMin` and the like through Warp's functions.
inline int __ffs(int mask) { return __builtin_ffs(mask); }
inline int __popc(unsigned mask) { return __builtin_popcount(mask); }
inline unsigned __brev(unsigned x) { return __builtin_bitreverse32(x); }
inline int __clz(int mask) { return mask ? __builtin_clz(mask) : 32; }
inline float __int_as_float(int bits) { return __builtin_bit_cast(float, bits); }
inline void __threadfence() {}
inline int __float_as_int(float number) { return __builtin_bit_cast(int, number); }

// For CUDA's fminf and fmaxf, -0 is less than 0, and NaN is left out. Warp's functions for the CPU return the first of two equal arguments.
inline float fminf(float a, float b) { return a != a || b < a || (a == b && __builtin_signbit(b)) ? b : a; }
inline float fmaxf(float a, float b) { return a != a || b > a || (a == b && !__builtin_signbit(b)) ? b : a; }

namespace wp {
template <class T> inline T cuda_min(T a, T b) { return min(a, b); }
template <class T> inline T cuda_max(T a, T b) { return max(a, b); }
inline float cuda_min(float a, float b) { return a == b && __builtin_signbit(b) ? b : min(a, b); }
inline float cuda_max(float a, float b) { return a == b && !__builtin_signbit(b) ? b : max(a, b); }
inline double cuda_min(double a, double b) { return a == b && __builtin_signbit(b) ? b : min(a, b); }
inline double cuda_max(double a, double b) { return a == b && !__builtin_signbit(b) ? b : max(a, b); }
template <unsigned N, class T> inline vec_t<N, T> cuda_min(vec_t<N, T> a, vec_t<N, T> b)
{
    for (unsigned i = 0; i < N; ++i) a[i] = cuda_min(a[i], b[i]);
    return a;
}
template <unsigned N, class T> inline vec_t<N, T> cuda_max(vec_t<N, T> a, vec_t<N, T> b)
{
    for (unsigned i = 0; i < N; ++i) a[i] = cuda_max(a[i], b[i]);
    return a;
}
template <unsigned N, class T> inline T cuda_min(vec_t<N, T> a)
{
    T out = a[0];
    for (unsigned i = 1; i < N; ++i) out = cuda_min(out, a[i]);
    return out;
}
template <unsigned N, class T> inline T cuda_max(vec_t<N, T> a)
{
    T out = a[0];
    for (unsigned i = 1; i < N; ++i) out = cuda_max(out, a[i]);
    return out;
}
template <class T> inline T cuda_clamp(T x, T a, T b) { return cuda_min(cuda_max(a, x), b); }
}
#define min cuda_min
#define max cuda_max
#define clamp cuda_clamp

namespace virtual_gpu {

struct Grid {
    uint3 blocks, threads;
    const unsigned* order;  // the indices of the threads in the grid, in the order in which they run; null: ascending
};

template <int... I> struct Places {};
template <class T, T... I> using PlacesOf = Places<I...>;

template <class... Arguments, int... I>
void run_each(void (*kernel)(Arguments...), void** arguments, const Grid& grid, Places<I...>)
{
    gridDim = grid.blocks;
    blockDim = grid.threads;
    const unsigned long long count = 1ull * gridDim.x * gridDim.y * gridDim.z * blockDim.x;
    for (unsigned long long i = 0; i < count; ++i) {
        const unsigned long long thread = grid.order ? grid.order[i] : i;
        const unsigned long long block = thread / blockDim.x;
        threadIdx = { unsigned(thread % blockDim.x), 0, 0 };
        blockIdx = { unsigned(block % gridDim.x), unsigned(block / gridDim.x % gridDim.y), unsigned(block / gridDim.x / gridDim.y) };
        kernel(*static_cast<Arguments*>(arguments[I])...);
    }
}

template <class... Arguments> void run(void (*kernel)(Arguments...), void** arguments, const Grid& grid)
{
    run_each(kernel, arguments, grid, __make_integer_seq<PlacesOf, int, sizeof...(Arguments)>());
}

}

