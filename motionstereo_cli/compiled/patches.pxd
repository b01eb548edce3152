cdef class FrameLevel:
    cdef public const unsigned char[::1] view
    cdef public const unsigned char[::1] other
    cdef public const float[::1] disparity
    cdef public int height
    cdef public int width


cdef class Block:
    cdef float[::1] values
    cdef int[::1] places
    cdef unsigned int[::1] pairs
    cdef int[:, ::1] aside
    cdef int[:, ::1] below
    cdef float[::1] numbers
    cdef double[::1] sums


cdef void take_cell(Block block, Py_ssize_t cell, int x, int y, float middle) noexcept nogil
cdef void compare_cells(FrameLevel now, FrameLevel then, Block block) noexcept nogil
cdef float take_patch(FrameLevel now, Block block, int x, int y, float middle) noexcept nogil
cdef void centre_patch(Block block, Py_ssize_t side, float count) noexcept nogil
cdef void compare_patch(FrameLevel then, Block block, Py_ssize_t side, float count, float right, float down) noexcept nogil
