#if defined(__CUDA_ARCH__)
    return {};  // CUDA runs the plain form
#else
    const float t_max = 0.0f;  // where the ray leaves does not matter here
    #include "node.h"
    wp::vec_t<WIDTH, wp::float32> out;
    __builtin_memcpy(&out, &enter, sizeof(out));
    return out;
#endif
