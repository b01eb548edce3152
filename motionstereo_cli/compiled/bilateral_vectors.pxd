from libc.stddef cimport ptrdiff_t


cdef extern from "bilateral.h" nogil:
    int HAS_LOOKUPS
    ptrdiff_t smooth_bytes(int width)
    void smooth_vectors(const unsigned char *view, int height, int width, unsigned char *memory,
                        unsigned char *result)
