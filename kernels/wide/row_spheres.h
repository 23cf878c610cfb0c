    #include "rows.h"
    typedef int RowInts __attribute__((ext_vector_type(WIDTH), aligned(4)));
    const RowInts id = *(const RowInts*)(rows.data + (long long)first + WIDTH * PRIM_ID_ROW);
    return ROW_MASK(id >= n_triangles) & mask;
