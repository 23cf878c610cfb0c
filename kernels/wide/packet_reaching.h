    #include "packet.h"
    return RAY_MASK(row(T) >= t_entry);
