#if defined(__CUDA_ARCH__)
    return 0;  // CUDA runs the plain form
#else
    #include "rows.h"
    const float* p = rows.data + (long long)first;
    #define CORNER(i, axis) (*(const Row*)(p + WIDTH * (3 * (i) + (axis))))
    const int kx = ray.kx, ky = ray.ky, kz = ray.kz;
    const float o_x = ray.origin[0], o_y = ray.origin[1], o_z = ray.origin[2], s_x = ray.shear_x, s_y = ray.shear_y;
    #include "edges.h"
    return ROW_MASK(~outside);
#endif
