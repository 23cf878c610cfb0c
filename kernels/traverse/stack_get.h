#if defined(__CUDA_ARCH__) && SHORT > 0
    if (i < SHORT) return ((TYPE*)shared)[i * WP_TILE_BLOCK_DIM];
#endif
    return entries[i];
