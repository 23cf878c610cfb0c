    alignas(TYPE) char memory[sizeof(TYPE)];
    return *(TYPE*)memory;
