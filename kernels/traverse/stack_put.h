#if defined(__CUDA_ARCH__) && SHORT > 0
    if (i < SHORT) {
        ((TYPE*)shared)[i * WP_TILE_BLOCK_DIM] = entry;
        return;
    }
#endif
    entries[i] = entry;
