#if defined(__CUDA_ARCH__)
    return 0;  // CUDA runs the plain form
#else
    #include "node.h"
    return ROW_MASK(enter <= leave) & exist;
#endif
