/* Vectors of 16-bit words and of bytes, from the vector types of GCC and clang.

   The same source becomes AVX2 (16 words at a time), SSE2 or NEON (8 words). Intrinsics stand only
   where C has no operator that compilers turn into one instruction: least, saturating difference,
   and widening. */

#ifndef VECTORS_H
#define VECTORS_H

#include <stdint.h>
#include <string.h>

#if defined(__AVX2__)
#include <immintrin.h>
#define LANES 16
#else
#if defined(__SSE2__)
#include <emmintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif
#define LANES 8
#endif

#define INLINE static inline __attribute__((always_inline))

typedef int16_t Words __attribute__((vector_size(2 * LANES)));
typedef uint8_t Bytes __attribute__((vector_size(16)));

typedef float Floats __attribute__((vector_size(32)));
typedef int32_t Ints __attribute__((vector_size(32)));
typedef int16_t Halves __attribute__((vector_size(16)));

/* In memory they may begin anywhere. They are seen as what they consist of. */
typedef int16_t WordsAt __attribute__((vector_size(2 * LANES), aligned(2)));
typedef uint8_t BytesAt __attribute__((vector_size(16), aligned(1)));

INLINE Words load(const int16_t *at) { return *(const WordsAt *)at; }
INLINE void store(int16_t *at, Words words) { *(WordsAt *)at = words; }
INLINE Words all_of(int value) { return (Words){0} + (int16_t)value; }
INLINE Bytes load_bytes(const uint8_t *at) { return *(const BytesAt *)at; }
INLINE void store_bytes(uint8_t *at, Bytes bytes) { *(BytesAt *)at = bytes; }
INLINE Bytes all_bytes(int value) { return (Bytes){0} + (uint8_t)value; }

/* The lesser of each two words. */
INLINE Words least(Words a, Words b)
{
#if defined(__AVX2__)
    return (Words)_mm256_min_epi16((__m256i)a, (__m256i)b);
#elif defined(__SSE2__)
    return (Words)_mm_min_epi16((__m128i)a, (__m128i)b);
#elif defined(__ARM_NEON)
    return (Words)vminq_s16((int16x8_t)a, (int16x8_t)b);
#else
    Words less = a < b;
    return (a & less) | (b & ~less);
#endif
}

/* The lesser of each two bytes. */
INLINE Bytes least_bytes(Bytes a, Bytes b)
{
#if defined(__SSE2__)
    return (Bytes)_mm_min_epu8((__m128i)a, (__m128i)b);
#elif defined(__ARM_NEON)
    return (Bytes)vminq_u8((uint8x16_t)a, (uint8x16_t)b);
#else
    Bytes less = (Bytes)(a < b);
    return (a & less) | (b & ~less);
#endif
}

/* a - b, or 0 where that is less than 0. */
INLINE Bytes excess(Bytes a, Bytes b)
{
#if defined(__SSE2__)
    return (Bytes)_mm_subs_epu8((__m128i)a, (__m128i)b);
#elif defined(__ARM_NEON)
    return (Bytes)vqsubq_u8((uint8x16_t)a, (uint8x16_t)b);
#else
    return (a - b) & (Bytes)(a > b);
#endif
}

/* The place of the first word that is true; LANES where none is. */
INLINE int first_true(Words truth)
{
#if defined(__AVX2__)
    unsigned bits = (unsigned)_mm256_movemask_epi8((__m256i)truth);
    return bits ? __builtin_ctz(bits) / 2 : LANES;
#elif defined(__SSE2__)
    unsigned bits = (unsigned)_mm_movemask_epi8((__m128i)truth);
    return bits ? __builtin_ctz(bits) / 2 : LANES;
#else
    int i = 0;
    while (i < LANES && !truth[i])
        i++;
    return i;
#endif
}

/* Bytes in memory as words. */
INLINE Words widened(const uint8_t *at)
{
#if defined(__AVX2__)
    return (Words)_mm256_cvtepu8_epi16((__m128i)load_bytes(at));
#elif defined(__SSE2__)
    return (Words)_mm_unpacklo_epi8(_mm_loadl_epi64((const __m128i *)at), _mm_setzero_si128());
#elif defined(__ARM_NEON)
    return (Words)vmovl_u8(vld1_u8(at));
#else
    Words words;
    for (int i = 0; i < LANES; i++)
        words[i] = at[i];
    return words;
#endif
}

#if LANES == 16
#define SHUFFLED __builtin_shufflevector

/* The least of all words, in each of them. */
INLINE Words least_of_all(Words a)
{
    a = least(a, SHUFFLED(a, a, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7));
    a = least(a, SHUFFLED(a, a, 4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11));
    a = least(a, SHUFFLED(a, a, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13));
    return least(a, SHUFFLED(a, a, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14));
}

/* The words one place before those of ``a``: the last of ``before`` comes first. */
INLINE Words one_before(Words before, Words a)
{
    return SHUFFLED(before, a, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30);
}

/* The words one place after those of ``a``: the first of ``after`` comes last. */
INLINE Words one_after(Words a, Words after)
{
    return SHUFFLED(a, after, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16);
}

/* 0, 1, 2, ... */
INLINE Words counted(void)
{
    return (Words){0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
}
#else
#define SHUFFLED __builtin_shufflevector

INLINE Words least_of_all(Words a)
{
    a = least(a, SHUFFLED(a, a, 4, 5, 6, 7, 0, 1, 2, 3));
    a = least(a, SHUFFLED(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
    return least(a, SHUFFLED(a, a, 1, 0, 3, 2, 5, 4, 7, 6));
}

INLINE Words one_before(Words before, Words a)
{
    return SHUFFLED(before, a, 7, 8, 9, 10, 11, 12, 13, 14);
}

INLINE Words one_after(Words a, Words after)
{
    return SHUFFLED(a, after, 1, 2, 3, 4, 5, 6, 7, 8);
}

INLINE Words counted(void) { return (Words){0, 1, 2, 3, 4, 5, 6, 7}; }
#endif

#endif
