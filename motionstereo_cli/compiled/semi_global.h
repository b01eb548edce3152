/* Semi-global matching in vectors: the same results to the bit as the loops of dense.py.

   The disparities of a pixel lie in chunks of 16. Each tile of the image has the set of chunks
   that are looked at there, a bit for each; all else costs OUTSIDE. Costs of pixels are bytes and
   are added up down before across. As in dense.py rows are taken in strips, the path from below
   first: an image of one strip is gone through up and down, one of several once more. */

#ifndef SEMI_GLOBAL_H
#define SEMI_GLOBAL_H

#include <limits.h>
#include <math.h>
#include <stddef.h>
#include <stdlib.h>

#include "vectors.h"

#define CHUNK 16
#define MAX_CHUNKS 64
#define PER_CHUNK (CHUNK / LANES)  /* vectors */
#define MAX_VECTORS (MAX_CHUNKS * PER_CHUNK)

/* Cost of what is not looked at; of what fills up the last chunk, and the sum of four paths of
   such costs still fits; and more than any. */
#define OUTSIDE 20000
#define PADDING 7000
#define MAX_COST 32767

/* The second best disparity is a rival where it costs less than this share more than the best. */
#define RIVAL_SHARE 0.1f

#define ALIGNMENT 64  /* of arrays, in bytes */

/* Or'ed to a cost it is about OUTSIDE, and a step more fits. */
#define FAR 16384

/* Chunks, a bit for each. */
typedef unsigned long long Set;

typedef struct {
    const uint8_t *right, *left;
    const int8_t *right_slope, *left_slope;
    const uint8_t *where;
    const float *proposed;
    const int16_t *weight;
    int rows, width, count;
    ptrdiff_t strip_bytes;  /* what costs and totals of a strip may take */
} View;

typedef struct {
    int max_grey, max_slope, step, leap, min_leap, per_grey_level;
    float min_margin, min_share;
} Penalties;

/* Sets of chunks, a row of tiles after the other. */
typedef struct {
    const Set *sets;
    int rows, width;  /* of a tile, px */
} Tiles;

/* The paths of all columns. */
typedef struct {
    int16_t *costs;  /* with a border of a chunk on both sides */
    int16_t *least;  /* below 0 where no path comes */
    Set *sets;       /* the chunks that each has */
} Columns;

typedef struct {
    View view;
    Penalties penalties;
    Tiles tiles;
    int chunks;
    ptrdiff_t line, path_line;    /* words of a pixel's costs, and of its path with a border */
    uint8_t *low, *high, *slope;  /* of a left row, continued by its last pixel */
    uint8_t *single;              /* costs of the pixels of three rows */
    uint8_t *column;              /* and added up down */
    Set *needed;             /* chunks of each pixel of a row, with a border of one */
    Columns up, down;             /* paths from below and from above */
    int16_t *across;              /* the path along a row */
    Set across_set;               /* the chunks that it has */
    int *best;
    int *partner;                 /* the least claim to each left pixel */
    int16_t *leap_along, *leap_across;  /* to each pixel from the row before, and from the left */
    int16_t *around;              /* of each pixel: costs before, at and after the best */
    int16_t *cost, *total;        /* of a strip, only what is in the sets; total: of the paths */
    int strip_rows;
    uint8_t *brought;             /* paths from below, as they come to each strip */
    float *margin, *rival;        /* of the row */
} Matching;

/* A part of a row, of tiles with the same set, and that set as a list of vectors. */
typedef struct {
    int begin, end, vectors;
    Set set;
    Words padding[PER_CHUNK];  /* added to the costs of the last ones */
    int at[MAX_VECTORS];       /* the first disparity of each */
} Stretch;

INLINE int tiles_across(const Matching *m)
{
    return (m->view.width + m->tiles.width - 1) / m->tiles.width;
}

INLINE const Set *sets_of_row(const Matching *m, int y)
{
    return m->tiles.sets + (ptrdiff_t)(y / m->tiles.rows) * tiles_across(m);
}

static void stretch_of(const Matching *m, int y, int first, int last, Stretch *stretch)
{
    int width = m->tiles.width;
    stretch->set = sets_of_row(m, y)[first];
    stretch->begin = first * width;
    stretch->end = (last + 1) * width < m->view.width ? (last + 1) * width : m->view.width;
    stretch->vectors = 0;
    for (Set rest = stretch->set; rest; rest &= rest - 1) {
        int chunk = __builtin_ctzll(rest);
        for (int i = 0; i < PER_CHUNK; i++)
            stretch->at[stretch->vectors++] = chunk * CHUNK + i * LANES;
    }
    for (int i = 0; i < PER_CHUNK; i++) {
        int beyond = m->view.count - stretch->at[stretch->vectors - PER_CHUNK + i];
        stretch->padding[i] = (counted() >= (int16_t)beyond) & PADDING;
    }
}

INLINE ptrdiff_t words_of(const Stretch *stretch)
{
    return (ptrdiff_t)(stretch->end - stretch->begin) * stretch->vectors * LANES;
}

/* Fill in the chunks that the windows of the pixels wanted in some rows take in. */
static void find_needed(const Matching *m, int first, int last)
{
    int width = m->view.width, tile_px = m->tiles.width;
    Set *needed = m->needed + 1;
    memset(m->needed, 0, (size_t)(width + 2) * sizeof(Set));
    for (int y = first < 0 ? 0 : first; y <= last && y < m->view.rows; y++) {
        const uint8_t *where = m->view.where + (ptrdiff_t)y * width;
        const Set *sets = sets_of_row(m, y);
        for (int begin = 0; begin < width; begin += tile_px) {
            Set set = *sets++;
            int end = begin + tile_px < width ? begin + tile_px : width;
            for (int x = begin; x < end; x++)
                needed[x] |= set & -(Set)where[x];
        }
    }
}

INLINE uint8_t *single_row(const Matching *m, int row)
{
    return m->single + (ptrdiff_t)((row + 3) % 3) * m->view.width * m->line;
}

/* Fill in the costs of the pixels of a row, that of the border where it lies beyond. */
static void differ(const Matching *m, int row)
{
    int width = m->view.width, last = width - 1;
    int y = row < 0 ? 0 : row < m->view.rows ? row : m->view.rows - 1;
    const uint8_t *left = m->view.left + (ptrdiff_t)y * width;
    const uint8_t *right = m->view.right + (ptrdiff_t)y * width;
    const int8_t *left_slope = m->view.left_slope + (ptrdiff_t)y * width;
    const int8_t *right_slope = m->view.right_slope + (ptrdiff_t)y * width;
    uint8_t *restrict low = m->low, *restrict high = m->high, *restrict slope = m->slope;
    for (int x = 0; x < width; x++)
        slope[x] = (uint8_t)(left_slope[x] + 128);
    for (int x = 0; x < width; x++) {
        uint8_t here = left[x];
        uint8_t before = (uint8_t)((here + left[x > 0 ? x - 1 : 0]) / 2);
        uint8_t after = (uint8_t)((here + left[x < last ? x + 1 : last]) / 2);
        uint8_t less = before < after ? before : after, more = before < after ? after : before;
        low[x] = here < less ? here : less;
        high[x] = here > more ? here : more;
    }
    /* What lies beyond the border is like the last pixel, and has no other neighbours. */
    memset(low + width, left[last], (size_t)m->line);
    memset(high + width, left[last], (size_t)m->line);
    memset(slope + width, (uint8_t)(left_slope[last] + 128), (size_t)m->line);

    find_needed(m, y - 1, y + 1);
    Bytes max_grey = all_bytes(m->penalties.max_grey), max_slope = all_bytes(m->penalties.max_slope);
    ptrdiff_t line = m->line;
    const Set *needed = m->needed;
    uint8_t *restrict cost = single_row(m, row);
    for (int x = 0; x < width; x++, cost += line) {
        Bytes grey = all_bytes(right[x]), lean = all_bytes(right_slope[x] + 128);
        for (Set rest = needed[x] | needed[x + 1] | needed[x + 2]; rest; rest &= rest - 1) {
            int d = __builtin_ctzll(rest) * CHUNK;
            Bytes lows = load_bytes(low + x + d), highs = load_bytes(high + x + d);
            Bytes slopes = load_bytes(slope + x + d);
            Bytes differs = least_bytes(excess(lows, grey) | excess(grey, highs), max_grey);
            Bytes leans = least_bytes(excess(slopes, lean) | excess(lean, slopes), max_slope);
            store_bytes(cost + d, differs + leans);
        }
    }
}

/* Add up the costs of three rows down. */
static void add_up(const Matching *m, int y)
{
    const uint8_t *above = single_row(m, y - 1), *here = single_row(m, y);
    const uint8_t *below = single_row(m, y + 1);
    find_needed(m, y, y);
    const Set *needed = m->needed;
    uint8_t *restrict column = m->column;
    for (int x = 0; x < m->view.width; x++) {
        ptrdiff_t pixel = x * m->line;
        for (Set rest = needed[x] | needed[x + 1] | needed[x + 2]; rest; rest &= rest - 1) {
            ptrdiff_t i = pixel + __builtin_ctzll(rest) * CHUNK;
            store_bytes(column + i,
                        load_bytes(above + i) + load_bytes(here + i) + load_bytes(below + i));
        }
    }
}

/* Prefer what is proposed. */
INLINE void propose(Words *cost, int vectors, const Stretch *s, int count, float wanted,
                    int16_t weight)
{
    if (!(wanted > -4 && wanted < count + 4))
        return;
    int first = (int)(wanted + 0.5f) - 2;
    Floats away = (Floats){0, 1, 2, 3, 4, 5, 6, 7} + ((float)first - wanted);
    Floats share = 1 - (Floats)((Ints)away & 0x7fffffff) / 2;  /* of the weight */
    Floats less = (Floats)((Ints)(share * (float)weight) & (share > 0));
    int16_t around[2 * LANES + 8] = {0};
    Halves whole = __builtin_convertvector(less, Halves);
    memcpy(around + LANES, &whole, sizeof whole);
    for (int i = 0; i < vectors; i++) {  /* without branches, which nothing foretells */
        int from = s->at[i] - first + LANES;
        from = from > 0 ? from : 0;
        cost[i] -= load(around + (from < LANES + 8 ? from : LANES + 8));
    }
}

/* The costs of a pixel's window, and more where another disparity is proposed. */
INLINE void costs_of(const Matching *m, const Stretch *s, int vectors, int y, int x, Words *cost)
{
    ptrdiff_t pixel = (ptrdiff_t)y * m->view.width + x;
    const uint8_t *here = m->column + x * m->line;
    const uint8_t *before = x > 0 ? here - m->line : here;
    const uint8_t *after = x < m->view.width - 1 ? here + m->line : here;
    int16_t weight = m->view.weight[pixel];
    Words more = all_of(weight);
    for (int i = 0; i < vectors; i++) {
        int d = s->at[i];
        cost[i] = widened(before + d) + widened(here + d) + widened(after + d) + more;
    }
    for (int i = 0; i < PER_CHUNK; i++)
        cost[vectors - PER_CHUNK + i] += s->padding[i];
    if (weight > 0)
        propose(cost, vectors, s, m->view.count, m->view.proposed[pixel], weight);
}

/* Fill in what a change by more than a step costs between the pixels of two rows. */
static void fill_leaps(const Matching *m, const uint8_t *grey, const uint8_t *beside, int width,
                       int16_t *restrict leaps)
{
    int16_t leap = (int16_t)m->penalties.leap, per_level = (int16_t)m->penalties.per_grey_level;
    int16_t min_leap = (int16_t)m->penalties.min_leap;
    for (int x = 0; x < width; x++) {
        int16_t here = (int16_t)(leap - per_level * abs(grey[x] - beside[x]));
        leaps[x] = here > min_leap ? here : min_leap;
    }
}

/* Make a path forget all chunks but those of a set. */
INLINE void forget(int16_t *path, Set chunks)
{
    for (; chunks; chunks &= chunks - 1)
        for (int i = 0; i < CHUNK; i += LANES)
            store(path + __builtin_ctzll(chunks) * CHUNK + i, all_of(OUTSIDE));
}

/* Take the path of a column to row ``y`` and return its costs; ``beside`` is the row it is from. */
INLINE void go_along_column(const Matching *m, const Stretch *s, int vectors, const Columns *columns,
                            int x, const Words *cost, Words *costs)
{
    int16_t *path = columns->costs + x * m->path_line + CHUNK, least_before = columns->least[x];
    Words minimum = all_of(MAX_COST);
    if (least_before < 0) {
        for (int i = 0; i < vectors; i++) {
            costs[i] = cost[i];
            store(path + s->at[i], cost[i]);
            minimum = least(minimum, cost[i]);
        }
    } else {
        Words step = all_of(m->penalties.step), limit = all_of(least_before + m->leap_along[x]);
        Words before = load(path + s->at[0] - 1);
        for (int i = 0; i < vectors; i++) {
            int d = s->at[i];
            Words change = least(before, load(path + d + 1)) + step;
            Words here = least(least(load(path + d), change), limit);
            if (i + 1 < vectors)
                before = load(path + s->at[i + 1] - 1);
            costs[i] = here - least_before + cost[i];
            store(path + d, costs[i]);
            minimum = least(minimum, costs[i]);
        }
    }
    if (columns->sets[x] != s->set) {
        forget(path, columns->sets[x] & ~s->set);
        columns->sets[x] = s->set;
    }
    columns->least[x] = least_of_all(minimum)[0];
}

/* A path along a row, held in registers within a stretch. */
typedef struct {
    int started;
    Words least;  /* of its costs, in all words */
} Across;

/* Take it to a pixel. ``fresh``: it comes from another stretch, and its costs are in memory. */
INLINE void go_across(const Matching *m, const Stretch *s, int vectors, int fresh, int16_t leap,
                      const Words *apart, const Words *cost, Words *path, Across *across)
{
    Words minimum = all_of(MAX_COST);
    if (!across->started) {
        for (int i = 0; i < vectors; i++) {
            path[i] = cost[i];
            minimum = least(minimum, cost[i]);
        }
    } else {
        const int16_t *memory = m->across + CHUNK;
        Words step = all_of(m->penalties.step), limit = across->least + leap;
        Words before = all_of(OUTSIDE);
        for (int i = 0; i < vectors; i++) {
            Words less, more, here = path[i];
            if (fresh) {
                less = load(memory + s->at[i] - 1);
                more = load(memory + s->at[i] + 1);
            } else {
                less = one_before(before | apart[i], here);
                more = i + 1 < vectors ? one_after(here, path[i + 1] | apart[i + 1])
                                       : one_after(here, all_of(OUTSIDE));
            }
            before = here;
            here = least(least(here, least(less, more) + step), limit);
            path[i] = here + (cost[i] - across->least);
            minimum = least(minimum, path[i]);
        }
    }
    across->least = least_of_all(minimum);
    across->started = 1;
}

INLINE void resume(const Matching *m, const Stretch *s, int vectors, Words *apart, Words *path)
{
    for (int i = 0; i < vectors; i++) {
        path[i] = load(m->across + CHUNK + s->at[i]);
        apart[i] = all_of(i > 0 && s->at[i - 1] + LANES == s->at[i] ? 0 : FAR);
    }
}

INLINE void suspend(Matching *m, const Stretch *s, int vectors, const Words *path)
{
    for (int i = 0; i < vectors; i++)
        store(m->across + CHUNK + s->at[i], path[i]);
    forget(m->across + CHUNK, m->across_set & ~s->set);
    m->across_set = s->set;
}

/* Find the costs of a stretch of a row, go up, and keep both. */
INLINE void go_up(const Matching *matching, const Stretch *stretch, int vectors, int y,
                  ptrdiff_t offset)
{
    /* Copies, of which the compiler knows that no store changes them. */
    const Matching local = *matching, *m = &local;
    const Stretch known = *stretch, *s = &known;
    const uint8_t *where = m->view.where + (ptrdiff_t)y * m->view.width;
    for (int x = s->begin; x < s->end; x++, offset += vectors * LANES) {
        if (!where[x]) {
            m->up.least[x] = -1;
            continue;
        }
        Words cost[MAX_VECTORS], costs[MAX_VECTORS];
        costs_of(m, s, vectors, y, x, cost);
        go_along_column(m, s, vectors, &m->up, x, cost, costs);
        for (int i = 0; i < vectors; i++) {
            store(m->cost + offset + i * LANES, cost[i]);
            store(m->total + offset + i * LANES, costs[i]);
        }
    }
}

/* Go down and to the right in a stretch of a row, and add both to the totals. */
INLINE void go_forward(Matching *matching, const Stretch *stretch, int vectors, int y,
                       ptrdiff_t offset, Across *across)
{
    /* Copies, of which the compiler knows that no store changes them. */
    const Matching local = *matching, *m = &local;
    const Stretch known = *stretch, *s = &known;
    const uint8_t *where = m->view.where + (ptrdiff_t)y * m->view.width;
    Words path[MAX_VECTORS], apart[MAX_VECTORS];
    int fresh = 1;
    resume(m, s, vectors, apart, path);
    for (int x = s->begin; x < s->end; x++, offset += vectors * LANES) {
        if (!where[x]) {
            m->down.least[x] = -1;
            across->started = 0;
            continue;
        }
        Words cost[MAX_VECTORS], costs[MAX_VECTORS];
        for (int i = 0; i < vectors; i++)
            cost[i] = load(m->cost + offset + i * LANES);
        go_along_column(m, s, vectors, &m->down, x, cost, costs);
        go_across(m, s, vectors, fresh, m->leap_across[x], apart, cost, path, across);
        fresh = 0;
        for (int i = 0; i < vectors; i++) {
            int16_t *total = m->total + offset + i * LANES;
            store(total, load(total) + costs[i] + path[i]);
        }
    }
    suspend(matching, s, vectors, path);
}

/* The place of the first of the words that is the least, in words. */
INLINE int place_of(const Words *words, int vectors, Words minimum)
{
    int place = vectors * LANES;
    for (int i = vectors - 1; i >= 0; i--) {
        int here = first_true(words[i] == minimum);
        place = here < LANES ? i * LANES + here : place;
    }
    return place;
}

/* A right pixel's claim to a left one: that of least cost, of equal costs that of the largest
   disparity, whose pixel lies farthest on the left. */
INLINE int claim_of(int cost, int disparity) { return cost << 16 | (MAX_COST - disparity); }
INLINE int disparity_of(int claim) { return MAX_COST - (claim & MAX_COST); }

/* The disparity of least cost of a pixel, and its margin; -1 where the margin is too small. */
INLINE void choose(const Matching *m, const Stretch *s, int vectors, int x, const Words *total)
{
    /* Its neighbours do not compete with the best: they are as if nothing cost more. */
    static const int16_t near[2 * LANES + 3] = {[LANES] = MAX_COST, MAX_COST, MAX_COST};
    Words minimum = total[0], others = all_of(MAX_COST);
    for (int i = 1; i < vectors; i++)
        minimum = least(minimum, total[i]);
    minimum = least_of_all(minimum);
    int cost = minimum[0], place = place_of(total, vectors, minimum);
    int d = s->at[place / LANES] + place % LANES;
    for (int i = 0; i < vectors; i++) {
        int from = s->at[i] - d + LANES + 1;
        from = from > 0 ? from : 0;
        others = least(others, total[i] | load(near + (from < LANES + 3 ? from : LANES + 3)));
    }
    others = least_of_all(others);
    int second = others[0];
    if (m->rival && second < PADDING && (float)(second - cost) < RIVAL_SHARE * second) {
        Words rival = all_of(MAX_COST);
        for (int i = 0; i < vectors; i++) {
            Words here = counted() + (int16_t)s->at[i], away = here - (int16_t)d;
            Words other = (total[i] == others) & ((away < -1) | (away > 1));
            rival = least(rival, (here | ~other) & MAX_COST);
        }
        m->rival[x] = least_of_all(rival)[0];
    }
    second = second < PADDING ? second : MAX_COST;
    int *partner = m->partner + x + d, claim = claim_of(cost, d);
    *partner = claim < *partner ? claim : *partner;
    float margin = (float)(second - cost), enough = m->penalties.min_share * second;
    enough = enough > m->penalties.min_margin ? enough : m->penalties.min_margin;
    m->best[x] = margin < enough ? -1 : d;
    m->margin[x] = margin;
    int16_t costs[MAX_VECTORS * LANES];
    for (int i = 0; i < vectors; i++)
        store(costs + i * LANES, total[i]);
    /* Of a neighbour that was not looked at, the other one's cost. */
    int last = d % CHUNK == CHUNK - 1;
    int has_before = d % CHUNK > 0 || (d > 0 && s->set >> (d / CHUNK - 1) & 1);
    int has_after = !last || (d / CHUNK + 1 < m->chunks && s->set >> (d / CHUNK + 1) & 1);
    int16_t *around = m->around + 3 * x;
    around[1] = (int16_t)cost;
    around[0] = costs[has_before ? place - 1 : has_after ? place + 1 : place];
    around[2] = has_after ? costs[place + 1] : around[0];
}

/* Go to the left in a stretch of a row, and choose. */
INLINE void go_back(Matching *matching, const Stretch *stretch, int vectors, int y, ptrdiff_t offset,
                    Across *across)
{
    /* Copies, of which the compiler knows that no store changes them. */
    const Matching local = *matching, *m = &local;
    const Stretch known = *stretch, *s = &known;
    const uint8_t *where = m->view.where + (ptrdiff_t)y * m->view.width;
    Words path[MAX_VECTORS], apart[MAX_VECTORS];
    int fresh = 1;
    resume(m, s, vectors, apart, path);
    offset += words_of(s);
    for (int x = s->end - 1; x >= s->begin; x--) {
        offset -= vectors * LANES;
        if (!where[x]) {
            across->started = 0;
            continue;
        }
        Words cost[MAX_VECTORS], total[MAX_VECTORS];
        for (int i = 0; i < vectors; i++)
            cost[i] = load(m->cost + offset + i * LANES);
        go_across(m, s, vectors, fresh, m->leap_across[x + 1], apart, cost, path, across);
        fresh = 0;
        for (int i = 0; i < vectors; i++)
            total[i] = load(m->total + offset + i * LANES) + path[i];
        choose(m, s, vectors, x, total);
    }
    suspend(matching, s, vectors, path);
}

/* Fill in a row: what both views agree on, between whole px where lines of equal slope meet. */
static void paint(const Matching *m, float *disparity, float *margin)
{
    int before = -2, width = m->view.width;
    for (int x = 0; x < width; x++) {
        int d = m->best[x];
        if (d >= 0 && (abs(disparity_of(m->partner[x + d]) - d) > 1
                       || (x + d >= width && abs(before - d) > 1)))
            d = -1;
        before = d >= 0 ? d : -2;
        if (d < 0) {
            disparity[x] = margin[x] = NAN;
            continue;
        }
        disparity[x] = (float)d;
        if (d > 0 && d < m->view.count - 1) {
            const int16_t *around = m->around + 3 * x;
            int below = around[0] - around[1], above = around[2] - around[1];
            int larger = below > above ? below : above;
            disparity[x] += (float)(below - above) / (2 * (larger > 1 ? larger : 1));
        }
    }
}

/* Loops over a number of vectors that is known are unrolled, and hold paths in registers. */
#define BY_NUMBER(stretch, call)                                        \
    switch ((stretch).vectors) {                                        \
    case PER_CHUNK: { enum { vectors = PER_CHUNK }; call; } break;      \
    case 2 * PER_CHUNK: { enum { vectors = 2 * PER_CHUNK }; call; } break; \
    case 3 * PER_CHUNK: { enum { vectors = 3 * PER_CHUNK }; call; } break; \
    case 4 * PER_CHUNK: { enum { vectors = 4 * PER_CHUNK }; call; } break; \
    case 5 * PER_CHUNK: { enum { vectors = 5 * PER_CHUNK }; call; } break; \
    default: { int vectors = (stretch).vectors; call; }                 \
    }

/* Nothing is wanted in a tile of a row. */
INLINE int is_idle(const Matching *m, const uint8_t *where, int tile)
{
    int begin = tile * m->tiles.width, left = m->view.width - begin;
    return !memchr(where + begin, 1, (size_t)(left < m->tiles.width ? left : m->tiles.width));
}

/* The last of the tiles from one on, in steps of 1 or -1, that have its set and are idle as it is. */
INLINE int last_alike(const Matching *m, int y, const uint8_t *where, int tile, int step)
{
    const Set *sets = sets_of_row(m, y);
    int idle = is_idle(m, where, tile), next = tile + step;
    while (next >= 0 && next < tiles_across(m) && sets[next] == sets[tile]
           && is_idle(m, where, next) == idle)
        next += step;
    return next - step;
}

static void row_up(Matching *m, int y, ptrdiff_t offset)
{
    const uint8_t *grey = m->view.right + (ptrdiff_t)y * m->view.width;
    const uint8_t *beside = y < m->view.rows - 1 ? grey + m->view.width : grey;
    fill_leaps(m, grey, beside, m->view.width, m->leap_along);
    const uint8_t *where = m->view.where + (ptrdiff_t)y * m->view.width;
    for (int tile = 0; tile < tiles_across(m);) {
        Stretch s;
        int last = last_alike(m, y, where, tile, 1);
        stretch_of(m, y, tile, last, &s);
        if (is_idle(m, where, tile))
            for (int x = s.begin; x < s.end; x++)
                m->up.least[x] = -1;
        else
            BY_NUMBER(s, go_up(m, &s, vectors, y, offset))
        offset += words_of(&s);
        tile = last + 1;
    }
}

static void row_down(Matching *m, int y, ptrdiff_t offset)
{
    int width = m->view.width;
    const uint8_t *where = m->view.where + (ptrdiff_t)y * width;
    const uint8_t *grey = m->view.right + (ptrdiff_t)y * width;
    fill_leaps(m, grey, y > 0 ? grey - width : grey, width, m->leap_along);
    fill_leaps(m, grey + 1, grey, width - 1, m->leap_across + 1);
    Across across = {0, {0}};
    Stretch s;
    for (int tile = 0; tile < tiles_across(m);) {
        int last = last_alike(m, y, where, tile, 1);
        stretch_of(m, y, tile, last, &s);
        if (is_idle(m, where, tile)) {
            across.started = 0;
            for (int x = s.begin; x < s.end; x++)
                m->down.least[x] = -1;
        } else
            BY_NUMBER(s, go_forward(m, &s, vectors, y, offset, &across))
        offset += words_of(&s);
        tile = last + 1;
    }
    for (int x = 0; x < width + m->view.count; x++)
        m->partner[x] = INT_MAX;
    for (int x = 0; x < width; x++)
        m->best[x] = -1;
    across.started = 0;
    for (int tile = tiles_across(m) - 1; tile >= 0;) {
        int first = last_alike(m, y, where, tile, -1);
        stretch_of(m, y, first, tile, &s);
        offset -= words_of(&s);
        if (is_idle(m, where, tile))
            across.started = 0;
        else
            BY_NUMBER(s, go_back(m, &s, vectors, y, offset, &across))
        tile = first - 1;
    }
}

static ptrdiff_t words_of_rows(const Matching *m, int first, int end)
{
    ptrdiff_t words = 0;
    int width = m->tiles.width, last = tiles_across(m) - 1;
    for (int y = first; y < end; y++) {
        const Set *sets = sets_of_row(m, y);
        for (int tile = 0; tile <= last; tile++) {
            int pixels = tile < last ? width : m->view.width - last * width;
            words += (ptrdiff_t)pixels * CHUNK * __builtin_popcountll(sets[tile]);
        }
    }
    return words;
}

/* Rows of a strip, so that its costs and totals take about as much as they may. */
static int rows_of_strip(const Matching *m)
{
    ptrdiff_t rows = m->view.rows, words = words_of_rows(m, 0, m->view.rows);
    ptrdiff_t bytes = (ptrdiff_t)(2 * sizeof(int16_t)) * words;
    ptrdiff_t strips = bytes / m->view.strip_bytes + 1;
    /* What is brought to a strip takes memory, too: more strips than this take more of both. */
    ptrdiff_t brought = (ptrdiff_t)sizeof(int16_t) * m->view.width * m->path_line;
    while (strips * (strips - 1) * brought > bytes)
        strips--;
    strips = strips < rows ? strips : rows;
    return (int)((rows + strips - 1) / strips);
}

static void begin(const Matching *m, Columns *columns)
{
    for (ptrdiff_t i = 0; i < m->view.width * m->path_line; i++)
        columns->costs[i] = OUTSIDE;
    for (int x = 0; x < m->view.width; x++) {
        columns->least[x] = -1;
        columns->sets[x] = 0;
    }
}

static void copy(const Matching *m, const Columns *from, const Columns *to)
{
    size_t width = (size_t)m->view.width;
    memcpy(to->costs, from->costs, width * (size_t)m->path_line * sizeof(int16_t));
    memcpy(to->least, from->least, width * sizeof(int16_t));
    memcpy(to->sets, from->sets, width * sizeof(Set));
}

static int end_of_strip(const Matching *m, int first)
{
    return first + m->strip_rows < m->view.rows ? first + m->strip_rows : m->view.rows;
}

/* Go up the rows of a strip. */
static void strip_up(Matching *m, int first, int end)
{
    ptrdiff_t offset = words_of_rows(m, first, end);
    for (int row = end; row >= first - 1; row--) {
        differ(m, row);
        int y = row + 1;
        if (y < end) {
            add_up(m, y);
            offset -= words_of_rows(m, y, y + 1);
            row_up(m, y, offset);
        }
    }
}

#define TAKE(array, number)                                              \
    array = (void *)*memory;                                             \
    *memory += ((number) * sizeof(*array) + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;

/* Where the paths of all columns lie in memory; moves it on behind them. */
static Columns columns_in(const Matching *m, uint8_t **memory)
{
    Columns columns;
    size_t width = (size_t)m->view.width;
    TAKE(columns.costs, width * (size_t)m->path_line)
    TAKE(columns.least, width)
    TAKE(columns.sets, width)
    return columns;
}

/* Lay out the workspace; return where it ends. */
static uint8_t *lay_out(Matching *m, uint8_t *start)
{
    uint8_t *position = start, **memory = &position;
    size_t width = (size_t)m->view.width, line = (size_t)m->line;
    TAKE(m->low, width + line)
    TAKE(m->high, width + line)
    TAKE(m->slope, width + line)
    TAKE(m->single, 3 * width * line)
    TAKE(m->column, width * line)
    TAKE(m->needed, width + 2)
    TAKE(m->across, (size_t)m->path_line)
    TAKE(m->best, width)
    TAKE(m->partner, width + line)
    TAKE(m->leap_along, width)
    TAKE(m->leap_across, width + 1)
    TAKE(m->around, 3 * width)
    m->down = columns_in(m, memory);
    m->strip_rows = rows_of_strip(m);
    size_t words = 0;
    m->brought = position;
    for (int first = 0; first < m->view.rows; first += m->strip_rows) {
        size_t more = (size_t)words_of_rows(m, first, end_of_strip(m, first));
        words = words > more ? words : more;
        columns_in(m, memory);
    }
    TAKE(m->cost, words)
    TAKE(m->total, words)
    return position;
}

/* What the path from below brings to the strip from row ``first`` on. */
static Columns brought_to(const Matching *m, int first)
{
    uint8_t *memory = m->brought;
    for (; first >= m->strip_rows; first -= m->strip_rows)
        columns_in(m, &memory);
    return columns_in(m, &memory);
}

static Matching matching_of(View view, Penalties penalties, Tiles tiles)
{
    Matching m = {.view = view, .penalties = penalties, .tiles = tiles};
    m.chunks = (view.count + CHUNK - 1) / CHUNK;
    m.line = m.chunks * CHUNK;
    m.path_line = m.line + 2 * CHUNK;
    return m;
}

/* How many bytes of memory the matching takes. */
static size_t workspace_bytes(View view, Tiles tiles)
{
    Matching m = matching_of(view, (Penalties){0}, tiles);
    return (size_t)((uintptr_t)lay_out(&m, (uint8_t *)ALIGNMENT) - ALIGNMENT) + ALIGNMENT;
}

/* Fill in disparity and margin, NaN = unknown, (rows, width) each; and, unless it is NULL,
   rivals. */
static void semi_global_vectors(View view, Penalties penalties, Tiles tiles, uint8_t *memory,
                                float *disparity, float *margin, float *rival)
{
    Matching matching = matching_of(view, penalties, tiles), *m = &matching;
    lay_out(m, memory + -(uintptr_t)memory % ALIGNMENT);
    for (ptrdiff_t i = 0; i < m->path_line; i++)
        m->across[i] = OUTSIDE;
    m->leap_across[0] = m->leap_across[view.width] = 0;  /* no path comes there */
    begin(m, &m->down);
    int first = (view.rows - 1) / m->strip_rows * m->strip_rows;
    m->up = brought_to(m, first);
    begin(m, &m->up);
    for (; first > 0; first -= m->strip_rows) {
        Columns before = m->up;
        m->up = brought_to(m, first - m->strip_rows);
        copy(m, &before, &m->up);
        strip_up(m, first, end_of_strip(m, first));
    }
    for (; first < view.rows; first += m->strip_rows) {
        int end = end_of_strip(m, first);
        ptrdiff_t offset = 0;
        m->up = brought_to(m, first);
        strip_up(m, first, end);
        for (int y = first; y < end; y++) {
            m->margin = margin + (ptrdiff_t)y * view.width;
            m->rival = rival ? rival + (ptrdiff_t)y * view.width : NULL;
            row_down(m, y, offset);
            paint(m, disparity + (ptrdiff_t)y * view.width, m->margin);
            offset += words_of_rows(m, y, y + 1);
        }
    }
}

#endif
