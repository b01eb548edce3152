from libc.stddef cimport ptrdiff_t


cdef extern from "semi_global.h" nogil:
    ctypedef struct View:
        const unsigned char *right
        const unsigned char *left
        const signed char *right_slope
        const signed char *left_slope
        const unsigned char *where
        const float *proposed
        const short *weight
        int rows
        int width
        int count
        ptrdiff_t strip_bytes

    ctypedef struct Penalties:
        int max_grey
        int max_slope
        int step
        int leap
        int min_leap
        int per_grey_level
        float min_margin
        float min_share

    ctypedef struct Tiles:
        const unsigned long long *sets
        int rows
        int width
        int chunk

    size_t workspace_bytes(View view, Tiles tiles)
    void semi_global_vectors(View view, Penalties penalties, Tiles tiles,
                             unsigned char *memory,
                             float *disparity, float *margin, float *rival)
