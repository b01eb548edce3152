/* The bilateral filter of bilateral.py with weights looked up 32 at a time: the same results. */

#ifndef BILATERAL_H
#define BILATERAL_H

#include "vectors.h"

#if defined(__AVX2__)
#define HAS_LOOKUPS 1

typedef __m256i Row;

/* The weight of the same grey, and in 256th of it that of pixels 1, sqrt(2) and 2 px away. */
enum { MOST = 150, BESIDE = 205, DIAGONAL = 164, SECOND = 105 };

/* Weights by difference of grey, 0 to 15 and 16 to 31. */
typedef struct {
    Row low, high;
} Table;

static Table table_of(int share)
{
    uint8_t weights[32];
    for (int i = 0; i < 32; i++) {
        int away = i < 29 ? i : 29, alike = (900 - away * away) / 8;
        alike = alike * alike / 64;
        weights[i] = (uint8_t)(alike * alike / 256 * share / 256);
    }
    return (Table){
        _mm256_broadcastsi128_si256(_mm_loadu_si128((const __m128i *)weights)),
        _mm256_broadcastsi128_si256(_mm_loadu_si128((const __m128i *)(weights + 16))),
    };
}

/* Of 32 pixels: weighted differences and weights so far, the even and the odd groups of eight. */
typedef struct {
    Row differences[2], weights[2];
} Sums;

INLINE Row looked_up(const Table *table, Row here, Row other)
{
    Row away = _mm256_or_si256(_mm256_subs_epu8(here, other), _mm256_subs_epu8(other, here));
    away = _mm256_min_epu8(away, _mm256_set1_epi8(31));
    /* A place with its highest bit set gives 0. */
    Row low = _mm256_shuffle_epi8(table->low, _mm256_add_epi8(away, _mm256_set1_epi8(0x70)));
    Row high = _mm256_shuffle_epi8(table->high, _mm256_sub_epi8(away, _mm256_set1_epi8(16)));
    return _mm256_or_si256(low, high);
}

/* Add two neighbours. A difference that does not fit a byte weighs nothing. */
INLINE void add_two(Sums *sums, const Table *table, Row here, const uint8_t *a, const uint8_t *b)
{
    Row one = _mm256_loadu_si256((const Row *)a), other = _mm256_loadu_si256((const Row *)b);
    Row weights[2] = {looked_up(table, here, one), looked_up(table, here, other)};
    Row brighter[2] = {_mm256_sub_epi8(one, here), _mm256_sub_epi8(other, here)};
    Row pairs[2] = {_mm256_unpacklo_epi8(weights[0], weights[1]),
                    _mm256_unpackhi_epi8(weights[0], weights[1])};
    Row apart[2] = {_mm256_unpacklo_epi8(brighter[0], brighter[1]),
                    _mm256_unpackhi_epi8(brighter[0], brighter[1])};
    for (int i = 0; i < 2; i++) {
        Row products = _mm256_maddubs_epi16(pairs[i], apart[i]);
        Row both = _mm256_maddubs_epi16(pairs[i], _mm256_set1_epi8(1));
        sums->differences[i] = _mm256_add_epi16(sums->differences[i], products);
        sums->weights[i] = _mm256_add_epi16(sums->weights[i], both);
    }
}

/* Quotients of 8 words each, rounded down. */
INLINE Row quotients(Row differences, Row weights)
{
    Row zero = _mm256_setzero_si256(), sign = _mm256_cmpgt_epi16(zero, differences);
    __m256 shift = _mm256_set1_ps(256);  /* makes them positive */
    Row parts[2] = {_mm256_unpacklo_epi16(differences, sign),
                    _mm256_unpackhi_epi16(differences, sign)};
    Row by[2] = {_mm256_unpacklo_epi16(weights, zero), _mm256_unpackhi_epi16(weights, zero)};
    for (int i = 0; i < 2; i++) {
        __m256 exact = _mm256_div_ps(_mm256_cvtepi32_ps(parts[i]), _mm256_cvtepi32_ps(by[i]));
        parts[i] = _mm256_cvttps_epi32(_mm256_add_ps(exact, shift));
        parts[i] = _mm256_sub_epi32(parts[i], _mm256_set1_epi32(256));
    }
    return _mm256_packs_epi32(parts[0], parts[1]);
}

INLINE int mirrored(int place, int size)
{
    place = place < 0 ? -place : place;
    place = place < size ? place : 2 * size - 2 - place;
    return place > 0 ? place : 0;
}

/* Bytes of a row continued by two pixels at each side, and readable 32 at a time. */
INLINE ptrdiff_t line_of(int width) { return width + 4 + 32; }

static ptrdiff_t smooth_bytes(int width) { return 5 * line_of(width); }

/* Fill in the view with less noise and sharp edges, (height, width). */
static void smooth_vectors(const uint8_t *view, int height, int width, uint8_t *memory,
                           uint8_t *result)
{
    const Table beside = table_of(BESIDE), diagonal = table_of(DIAGONAL), second = table_of(SECOND);
    ptrdiff_t line = line_of(width);
    memset(memory, 0, (size_t)(5 * line));
    for (int last = -2; last < height + 2; last++) {
        const uint8_t *from = view + (ptrdiff_t)mirrored(last, height) * width;
        uint8_t *row = memory + (last + 5) % 5 * line;
        memcpy(row + 2, from, (size_t)width);
        for (int i = 1; i < 3; i++) {
            row[2 - i] = from[mirrored(-i, width)];
            row[width + 1 + i] = from[mirrored(width - 1 + i, width)];
        }
        int y = last - 2;
        if (y < 0)
            continue;
        const uint8_t *rows[5];
        for (int i = 0; i < 5; i++)
            rows[i] = memory + (y + 3 + i) % 5 * line + 2;
        for (int x = 0; x < width; x += 32) {
            const uint8_t *here = rows[2] + x, *above = rows[1] + x, *below = rows[3] + x;
            Row grey = _mm256_loadu_si256((const Row *)here);
            Row most = _mm256_set1_epi16(MOST), zero = _mm256_setzero_si256();
            Sums sums = {{zero, zero}, {most, most}};
            add_two(&sums, &beside, grey, here - 1, here + 1);
            add_two(&sums, &beside, grey, above, below);
            add_two(&sums, &diagonal, grey, above - 1, above + 1);
            add_two(&sums, &diagonal, grey, below - 1, below + 1);
            add_two(&sums, &second, grey, here - 2, here + 2);
            add_two(&sums, &second, grey, rows[0] + x, rows[4] + x);
            Row change = _mm256_packs_epi16(quotients(sums.differences[0], sums.weights[0]),
                                            quotients(sums.differences[1], sums.weights[1]));
            uint8_t found[32];
            _mm256_storeu_si256((Row *)found, _mm256_add_epi8(grey, change));
            memcpy(result + (ptrdiff_t)y * width + x, found,
                   (size_t)(width - x < 32 ? width - x : 32));
        }
    }
}
#else
#define HAS_LOOKUPS 0

static ptrdiff_t smooth_bytes(int width) { return width; }

static void smooth_vectors(const uint8_t *view, int height, int width, uint8_t *memory,
                           uint8_t *result)
{
    (void)view, (void)height, (void)width, (void)memory, (void)result;
}
#endif

#endif
