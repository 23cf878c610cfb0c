#if defined(__CUDA_ARCH__) && SHORT > 0
    // Entries of one depth lie side by side, so that threads of a warp never meet in a bank of the memory.
    __shared__ TYPE first[SHORT * WP_TILE_BLOCK_DIM];
    return (wp::uint64)(first + threadIdx.x);
#else
    return 0;
#endif
