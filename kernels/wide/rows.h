    // A row has one number of each child of a node, or of each triangle of a leaf. Vectors are the compiler's own extension: they
    // name no instruction set, and run on every CPU.
    typedef float Row __attribute__((ext_vector_type(WIDTH), aligned(4)));
    typedef bool RowBools __attribute__((ext_vector_type(WIDTH)));
    #define ROW_MASK(x) (__builtin_bit_cast(unsigned char, __builtin_convertvector((x), RowBools)) & ((1 << WIDTH) - 1))
