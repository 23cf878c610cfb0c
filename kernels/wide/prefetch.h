#if !defined(__CUDA_ARCH__)
    for (int k = 0; k < lines; ++k) __builtin_prefetch(rows.data + (long long)first + CACHE_LINE * k);
#endif
