/* Vectors of 16-bit words and of bytes, from the vector types of GCC and clang.

   The same source becomes AVX2 (16 words at a time), SSE2 or NEON (8 words). Intrinsics stand only
   where C has no operator that compilers turn into one instruction: least, saturating difference,
   and widening. */

#ifndef VECTORS_H
#define VECTORS_H

#include <stddef.h>
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
typedef uint8_t Bytes __attribute__((vector_size(2 * LANES)));

typedef int16_t Halves __attribute__((vector_size(16)));

/* In memory they may begin anywhere. They are seen as what they consist of. */
typedef int16_t WordsAt __attribute__((vector_size(2 * LANES), aligned(2)));
typedef uint8_t BytesAt __attribute__((vector_size(2 * LANES), aligned(1)));

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
#if defined(__AVX2__)
    return (Bytes)_mm256_min_epu8((__m256i)a, (__m256i)b);
#elif defined(__SSE2__)
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
#if defined(__AVX2__)
    return (Bytes)_mm256_subs_epu8((__m256i)a, (__m256i)b);
#elif defined(__SSE2__)
    return (Bytes)_mm_subs_epu8((__m128i)a, (__m128i)b);
#elif defined(__ARM_NEON)
    return (Bytes)vqsubq_u8((uint8x16_t)a, (uint8x16_t)b);
#else
    return (a - b) & (Bytes)(a > b);
#endif
}

/* The words of ``a`` where ``mask`` is true, in all its bits, and of ``b`` elsewhere. */
INLINE Words chosen(Words mask, Words a, Words b)
{
#if defined(__AVX2__)
    return (Words)_mm256_blendv_epi8((__m256i)b, (__m256i)a, (__m256i)mask);
#else
    return (a & mask) | (b & ~mask);
#endif
}

/* Bytes in memory as words. */
INLINE Words widened(const uint8_t *at)
{
#if defined(__AVX2__)
    return (Words)_mm256_cvtepu8_epi16(_mm_loadu_si128((const __m128i *)at));
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

/* Store words as bytes, which they have to fit in. */
INLINE void store_narrowed(uint8_t *at, Words words)
{
#if defined(__AVX2__)
    __m128i low = _mm256_castsi256_si128((__m256i)words);
    __m128i high = _mm256_extracti128_si256((__m256i)words, 1);
    _mm_storeu_si128((__m128i *)at, _mm_packus_epi16(low, high));
#elif defined(__SSE2__)
    _mm_storel_epi64((__m128i *)at, _mm_packus_epi16((__m128i)words, (__m128i)words));
#elif defined(__ARM_NEON)
    vst1_u8(at, vqmovun_s16((int16x8_t)words));
#else
    for (int i = 0; i < LANES; i++)
        at[i] = (uint8_t)words[i];
#endif
}

#define SHUFFLED __builtin_shufflevector

#if LANES == 16
/* The least of all words, in each of them. */
INLINE Words least_of_all(Words a)
{
    a = least(a, SHUFFLED(a, a, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7));
    a = least(a, SHUFFLED(a, a, 4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11));
    a = least(a, SHUFFLED(a, a, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13));
    return least(a, SHUFFLED(a, a, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14));
}

/* Of each eight words, the first or the last four, in turn with those of ``b``. */
INLINE Words first_in_turn(Words a, Words b)
{
    return SHUFFLED(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 8, 24, 9, 25, 10, 26, 11, 27);
}

INLINE Words last_in_turn(Words a, Words b)
{
    return SHUFFLED(a, b, 4, 20, 5, 21, 6, 22, 7, 23, 12, 28, 13, 29, 14, 30, 15, 31);
}

/* Eight words from here, and in wider vectors eight from there. */
INLINE Words joined(const int16_t *a, const int16_t *b)
{
    typedef int16_t HalvesAt __attribute__((vector_size(16), aligned(2)));
    Halves here = *(const HalvesAt *)a, there = *(const HalvesAt *)b;
    return SHUFFLED(here, there, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
#else
INLINE Words least_of_all(Words a)
{
    a = least(a, SHUFFLED(a, a, 4, 5, 6, 7, 0, 1, 2, 3));
    a = least(a, SHUFFLED(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
    return least(a, SHUFFLED(a, a, 1, 0, 3, 2, 5, 4, 7, 6));
}

INLINE Words first_in_turn(Words a, Words b) { return SHUFFLED(a, b, 0, 8, 1, 9, 2, 10, 3, 11); }
INLINE Words last_in_turn(Words a, Words b) { return SHUFFLED(a, b, 4, 12, 5, 13, 6, 14, 7, 15); }
INLINE Words joined(const int16_t *a, const int16_t *b) { return (void)b, load(a); }
#endif

/* Turn LANES x LANES words: what is a row becomes a column. Steps are words from row to row. */
INLINE void turn(const int16_t *from, ptrdiff_t from_step, int16_t *to, ptrdiff_t to_step)
{
    for (int half = 0; half < LANES; half += 8) {
        Words a[8], b[8];
        for (int i = 0; i < 8; i++) {
            const int16_t *at = from + i * from_step + half;
            a[i] = joined(at, at + 8 * from_step);
        }
        /* Each round moves one bit of the row's number to the column's. */
        for (int round = 0; round < 3; round++) {
            for (int i = 0; i < 4; i++) {
                b[2 * i] = first_in_turn(a[i], a[i + 4]);
                b[2 * i + 1] = last_in_turn(a[i], a[i + 4]);
            }
            memcpy(a, b, sizeof a);
        }
        for (int i = 0; i < 8; i++)
            store(to + (half + i) * to_step, a[i]);
    }
}

#endif
