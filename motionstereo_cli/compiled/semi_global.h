/* Semi-global matching in vectors: the same results to the bit as the loops of dense.py.

   A vector holds one disparity of LANES pixels: of a row for paths up and down, of a column for
   paths along rows. So no step needs what lies beside it in a vector. The image is a grid of
   blocks of LANES x LANES pixels, which are turned in between; a band is a row of blocks.

   Each tile of the image has the set of disparities that are looked at there; all else costs
   OUTSIDE. The path from below comes first and its costs are kept, in strips of bands: an image of
   one strip is gone through up and down, one of several once more. */

#ifndef SEMI_GLOBAL_H
#define SEMI_GLOBAL_H

#include <limits.h>
#include <math.h>
#include <stdlib.h>

#include "vectors.h"

/* Cost of what is not looked at, more than any path's; and more than any. */
#define OUTSIDE 20000
#define MAX_COST 32767

/* The second best disparity is a rival where it costs less than this share more than the best. */
#define RIVAL_SHARE 0.1f

/* Proposals are in parts of a px, and reach so many parts. */
#define PARTS 16
#define REACH (2 * PARTS)

#define ALIGNMENT 64  /* of arrays, in bytes */
#define HALO (LANES / 2)  /* pixels at each side of a block */
#define LINES (LANES + 2)  /* rows of a band, with one above and one below */

/* Chunks of disparities, a bit for each. */
typedef unsigned long long Set;
#define MAX_CHUNKS 64

typedef struct {
    const uint8_t *right, *left;
    const int8_t *right_slope, *left_slope;
    const uint8_t *where;
    const float *proposed;
    const int16_t *weight;
    int rows, width, count;
    ptrdiff_t strip_bytes;  /* what the costs of paths from below may take */
} View;

typedef struct {
    int max_grey, max_slope, step, leap, min_leap, per_grey_level;
    float min_margin, min_share;
} Penalties;

/* Sets of chunks, a row of tiles after the other. */
typedef struct {
    const Set *sets;
    int rows, width;  /* of a tile, px: multiples of 16, or all of the image */
    int chunk;        /* disparities in a chunk */
} Tiles;

/* Disparities from ``begin`` on, and the place of the first in a list of all. */
typedef struct {
    int begin, end, place;
} Run;

/* What is looked at in a block: nothing where no pixel is wanted. */
typedef struct {
    Set set;
    int count, runs;
    Run run[MAX_CHUNKS / 2 + 1];
} Choice;

/* Paths of some blocks of pixels: those of all columns, or of all rows of a band. */
typedef struct {
    int16_t *costs;  /* of each disparity, with one more at each side */
    int16_t *least;  /* below 0 where no path comes */
    Set *sets;       /* the chunks that each has */
} Paths;

/* What is found of the pixels of a band: the best disparity, -1 = not wanted, its cost, that of the
   second best, those of its neighbours, MAX_COST = not looked at; and the second best. */
enum { BEST, COST, SECOND_COST, BEFORE, AFTER, RIVAL, RESULTS };

typedef struct {
    View view;
    Penalties penalties;
    Tiles tiles;
    int blocks, bands, strip_bands;
    ptrdiff_t line;         /* bytes of a row with what is beyond its ends */
    ptrdiff_t path;         /* words of the path of a block */
    uint8_t *right, *lean;  /* grey and slope of the rows of a band, */
    uint8_t *grey, *low, *high, *slope;  /* and of the left view, continued by its last pixel */
    int16_t *where, *where_across;  /* the pixels of a band, all bits = wanted, and turned */
    int16_t *weight, *wanted;       /* and what is proposed for them */
    int16_t *leap, *leap_across;
    uint8_t *sums;          /* costs of pixels of a block at a disparity, of three rows each */
    int16_t *cost, *total;  /* of a block */
    int16_t *cost_across, *total_across;  /* of a band, turned */
    int16_t *found;         /* of a band: all results of a row after the other */
    int *partner;           /* the least claim to each left pixel of a row, and to none */
    uint8_t *kept;          /* of a strip: what paths from below add */
    Paths up, down, across;
    uint8_t *brought;       /* paths from below, as they come to each strip */
} Matching;

INLINE ptrdiff_t columns(const Matching *m) { return (ptrdiff_t)m->blocks * LANES; }

static int is_idle(const Matching *m, int band, int block)
{
    int begin = block * LANES, width = m->view.width - begin;
    int end = (band + 1) * LANES < m->view.rows ? (band + 1) * LANES : m->view.rows;
    for (int y = band * LANES; y < end; y++)
        if (memchr(m->view.where + (ptrdiff_t)y * m->view.width + begin, 1,
                   (size_t)(width < LANES ? width : LANES)))
            return 0;
    return 1;
}

static void choice_of(const Matching *m, int band, int block, Choice *choice)
{
    int across = (m->view.width + m->tiles.width - 1) / m->tiles.width, size = m->tiles.chunk;
    choice->set = choice->count = choice->runs = 0;
    if (is_idle(m, band, block))
        return;
    choice->set = m->tiles.sets[(ptrdiff_t)(band * LANES / m->tiles.rows) * across
                                + block * LANES / m->tiles.width];
    for (Set rest = choice->set; rest; rest &= rest - 1) {
        int begin = __builtin_ctzll(rest) * size;
        int end = begin + size < m->view.count ? begin + size : m->view.count;
        Run *last = choice->run + choice->runs - 1;
        if (choice->runs > 0 && last->end == begin)
            last->end = end;
        else
            choice->run[choice->runs++] = (Run){begin, end, choice->count};
        choice->count += end - begin;
    }
}

/* How many costs a block has. */
INLINE ptrdiff_t costs_of(const Choice *choice) { return (ptrdiff_t)choice->count * LANES * LANES; }

/* Fill in what a change by more than a step costs between pixels and those beside them. */
static void fill_leaps(const Matching *m, const uint8_t *grey, const uint8_t *beside,
                       int16_t *restrict leaps)
{
    int16_t leap = (int16_t)m->penalties.leap, per_level = (int16_t)m->penalties.per_grey_level;
    int16_t min_leap = (int16_t)m->penalties.min_leap;
    ptrdiff_t width = columns(m);
    for (ptrdiff_t x = 0; x < width; x++) {
        int16_t here = (int16_t)(leap - per_level * abs(grey[x] - beside[x]));
        leaps[x] = here > min_leap ? here : min_leap;
    }
}

/* Copy a row and continue it at both ends. */
static void extend(const uint8_t *row, int width, ptrdiff_t line, uint8_t *result)
{
    memset(result, row[0], HALO);
    memcpy(result + HALO, row, (size_t)width);
    memset(result + HALO + width, row[width - 1], (size_t)(line - HALO - width));
}

/* The same of slopes, as bytes without signs in the same order. */
static void extend_slopes(const int8_t *row, int width, ptrdiff_t line, uint8_t *result)
{
    extend((const uint8_t *)row, width, line, result);
    for (ptrdiff_t x = 0; x < line; x += 2 * LANES)
        store_bytes(result + x, load_bytes(result + x) ^ all_bytes(128));
}

/* Means, rounded down. */
INLINE Bytes means(Bytes a, Bytes b) { return (a & b) + (((a ^ b) >> 1) & all_bytes(127)); }

/* Fill in the least and the largest grey within half a pixel. ``grey`` is from one before on. */
static void find_ranges(const uint8_t *grey, ptrdiff_t line, uint8_t *low, uint8_t *high)
{
    for (ptrdiff_t x = 0; x < line; x += 2 * LANES) {
        Bytes here = load_bytes(grey + x + 1);
        Bytes before = means(here, load_bytes(grey + x));
        Bytes after = means(here, load_bytes(grey + x + 2));
        store_bytes(low + x, least_bytes(here, least_bytes(before, after)));
        store_bytes(high + x, ~least_bytes(~here, least_bytes(~before, ~after)));
    }
}

/* Fill in the pixels of a row that are wanted, and what is proposed for them. */
static void read_wishes(const Matching *m, int row, ptrdiff_t to)
{
    ptrdiff_t from = (ptrdiff_t)row * m->view.width, width = m->view.width;
    const uint8_t *where = m->view.where + from;
    const float *proposed = m->view.proposed + from;
    int16_t *restrict wanted = m->wanted + to, *restrict mask = m->where + to;
    float most = (float)(m->view.count + 3);
    for (ptrdiff_t x = 0; x < width; x++)
        mask[x] = (int16_t)-where[x];
    for (ptrdiff_t x = 0; x < width; x++) {
        float parts = (proposed[x] > -3 && proposed[x] < most ? proposed[x] : -3) * PARTS;
        wanted[x] = (int16_t)(int)parts;
    }
    memcpy(m->weight + to, m->view.weight + from, (size_t)width * sizeof(int16_t));
}

/* Read the rows of a band. Rows beyond the image are like its first or last one. */
static void read_band(const Matching *m, int band)
{
    int width = m->view.width, rows = m->view.rows;
    for (int i = 0; i < LINES; i++) {
        int y = band * LANES + i - 1;
        y = y < 0 ? 0 : y < rows ? y : rows - 1;
        ptrdiff_t from = (ptrdiff_t)y * width, to = i * m->line;
        extend(m->view.right + from, width, m->line, m->right + to);
        extend_slopes(m->view.right_slope + from, width, m->line, m->lean + to);
        extend_slopes(m->view.left_slope + from, width, m->line, m->slope + to);
        m->grey[0] = m->view.left[from];
        extend(m->view.left + from, width, m->line + 1, m->grey + 1);
        find_ranges(m->grey, m->line, m->low + to, m->high + to);
    }
    memset(m->where, 0, (size_t)columns(m) * LANES * sizeof(int16_t));
    memset(m->weight, 0, (size_t)columns(m) * LANES * sizeof(int16_t));
    for (int y = 0; y < LANES && band * LANES + y < rows; y++)
        read_wishes(m, band * LANES + y, y * columns(m));
}

/* The costs of pixels from a place on in the right view and another in the left one. */
INLINE Bytes difference(const Matching *m, ptrdiff_t right, ptrdiff_t at)
{
    Bytes grey = load_bytes(m->right + right), lean = load_bytes(m->lean + right);
    Bytes low = load_bytes(m->low + at), high = load_bytes(m->high + at);
    Bytes slope = load_bytes(m->slope + at);
    Bytes differs = excess(low, grey) | excess(grey, high);
    Bytes leans = excess(slope, lean) | excess(lean, slope);
    return least_bytes(differs, all_bytes(m->penalties.max_grey))
           + least_bytes(leans, all_bytes(m->penalties.max_slope));
}

/* Fill in the costs of a block's windows, (LANES, disparities, LANES). */
static void fill_costs(const Matching *matching, int block, const Choice *choice)
{
    const Matching local = *matching, *m = &local;  /* of which is known that nothing changes it */
    ptrdiff_t begin = (ptrdiff_t)block * LANES, step = (ptrdiff_t)choice->count * LANES;
    int last = m->view.width - (int)begin - 1;
    for (int i = 0; i < choice->runs; i++) {
        const Run run = choice->run[i];
        for (int d = run.begin; d < run.end; d++) {
            ptrdiff_t at = begin + d;
            Bytes above = difference(m, begin, at), here = difference(m, begin + m->line, at + m->line);
            for (int y = 0; y < LANES; y++) {
                ptrdiff_t line = (y + 2) * m->line;
                Bytes below = difference(m, begin + line, at + line);
                store_bytes(m->sums + 2 * LANES * y, above + here + below);
                above = here;
                here = below;
            }
            /* What lies beyond the border is like the last pixel. */
            for (uint8_t *sum = m->sums + HALO; block == 0 && sum < m->sums + 2 * LANES * LANES;
                 sum += 2 * LANES)
                sum[-1] = sum[0];
            for (uint8_t *sum = m->sums + HALO; last < LANES && sum < m->sums + 2 * LANES * LANES;
                 sum += 2 * LANES)
                sum[last + 1] = sum[last];
            int16_t *cost = m->cost + (ptrdiff_t)(run.place + d - run.begin) * LANES;
            for (int y = 0; y < LANES; y++) {
                const uint8_t *sum = m->sums + 2 * LANES * y + HALO;
                store(cost + y * step, widened(sum - 1) + widened(sum) + widened(sum + 1)
                                       + load(m->weight + begin + y * columns(m)));
            }
        }
    }
}

/* Prefer what is proposed: take off a share of the weight, less with the distance from it. */
static void prefer(const Matching *m, int block, const Choice *choice)
{
    Words any = all_of(0);
    for (int y = 0; y < LANES; y++)
        any |= load(m->weight + y * columns(m) + (ptrdiff_t)block * LANES);
    if (least_of_all(-any)[0] == 0)
        return;
    for (int y = 0; y < LANES; y++) {
        ptrdiff_t at = y * columns(m) + (ptrdiff_t)block * LANES;
        Words weight = load(m->weight + at), wanted = load(m->wanted + at), some = weight > 0;
        int first = least_of_all(chosen(some, wanted, all_of(MAX_COST)))[0];
        int last = -least_of_all(chosen(some, -wanted, all_of(MAX_COST)))[0];
        for (int i = 0; i < choice->runs; i++) {
            const Run run = choice->run[i];
            int begin = (first - REACH) / PARTS, end = (last + REACH) / PARTS + 1;
            begin = begin > run.begin ? begin : run.begin;
            end = end < run.end ? end : run.end;
            int16_t *cost = m->cost
                            + ((ptrdiff_t)y * choice->count + run.place - run.begin) * LANES;
            for (int d = begin; d < end; d++) {
                Words away = wanted - (int16_t)(d * PARTS);
                Words share = REACH + least(away, -away);
                share &= (share > 0) & some;
                store(cost + (ptrdiff_t)d * LANES,
                      load(cost + (ptrdiff_t)d * LANES) - ((share * weight) >> 5));
            }
        }
    }
}

static void price(const Matching *m, int block, const Choice *choice)
{
    fill_costs(m, block, choice);
    prefer(m, block, choice);
}

/* Make the paths of a block have the disparities of a choice, and no more. */
static void adopt(const Matching *m, const Paths *paths, int block, const Choice *choice)
{
    int16_t *costs = paths->costs + block * m->path + LANES;
    for (Set gone = paths->sets[block] & ~choice->set; gone; gone &= gone - 1) {
        int begin = __builtin_ctzll(gone) * m->tiles.chunk, end = begin + m->tiles.chunk;
        for (int d = begin; d < end && d < m->view.count; d++)
            store(costs + (ptrdiff_t)d * LANES, all_of(OUTSIDE));
    }
    paths->sets[block] = choice->set;
}

/* What becomes of the costs of paths: what a step adds to that of the pixels is kept, half of it so
   that it fits in a byte, or taken from where it was kept and added to a total besides; or they are
   added to a total. */
typedef struct {
    uint8_t *kept;
    const uint8_t *taken;
    const int16_t *before;
    int16_t *total;
} Use;

/* Take paths to the next pixels. ``costs`` are of the paths, ``least`` the least of them, below 0
   where a path begins; ``cost`` is that of the pixels. Return the least of them now. */
INLINE Words go_on(const Choice *choice, int16_t *costs, Words least_before, Words leap, Words step,
                   const int16_t *cost, Use use)
{
    Words started = least_before >= 0, minimum = all_of(MAX_COST);
    Words limit = (least_before + leap) & started, by = least_before & started;
    for (int i = 0; i < choice->runs; i++) {
        const Run run = choice->run[i];
        int16_t *path = costs + (ptrdiff_t)run.begin * LANES;
        ptrdiff_t at = (ptrdiff_t)run.place * LANES;
        ptrdiff_t end = at + (ptrdiff_t)(run.end - run.begin) * LANES;
        Words before = all_of(OUTSIDE), here = load(path);
        for (; at < end; at += LANES) {
            Words after = load(path + LANES), own = load(cost + at);
            Words change = least(least(before, after) + step, least(here, limit)) - by;
            Words now = change + own;
            store(path, now);
            minimum = least(minimum, now);
            if (use.kept)
                store_narrowed(use.kept + at, change >> 1);
            if (use.taken)
                now += (widened(use.taken + at) << 1) + own;
            if (use.before)
                now += load(use.before + at);
            if (use.total)
                store(use.total + at, now);
            before = here;
            here = after;
            path += LANES;
        }
    }
    return minimum;
}

/* Go up a band, and keep what the paths add. */
static void band_up(const Matching *m, int band, uint8_t *kept)
{
    Words step = all_of(m->penalties.step);
    read_band(m, band);
    for (int y = 0; y < LANES; y++) {
        const uint8_t *here = m->right + (y + 1) * m->line + HALO;
        fill_leaps(m, here, here + m->line, m->leap + y * columns(m));
    }
    for (int block = 0; block < m->blocks; block++) {
        Choice choice;
        choice_of(m, band, block, &choice);
        Words now = all_of(-1);
        if (choice.count > 0) {
            int16_t *costs = m->up.costs + block * m->path + LANES;
            adopt(m, &m->up, block, &choice);
            price(m, block, &choice);
            now = load(m->up.least + block * LANES);
            for (int y = LANES - 1; y >= 0; y--) {
                ptrdiff_t at = y * columns(m) + (ptrdiff_t)block * LANES;
                ptrdiff_t row = (ptrdiff_t)y * choice.count * LANES;
                now = go_on(&choice, costs, now, load(m->leap + at), step, m->cost + row,
                            (Use){.kept = kept + row});
                now = chosen(load(m->where + at), now, all_of(-1));
            }
            kept += costs_of(&choice);
        }
        store(m->up.least + block * LANES, now);
    }
}

/* Go down a block, turn its costs and totals, and go to the right. */
static void block_forward(const Matching *m, int block, const Choice *choice, const uint8_t *kept,
                          int16_t *cost_across, int16_t *total_across)
{
    Words step = all_of(m->penalties.step);
    ptrdiff_t row = (ptrdiff_t)choice->count * LANES;
    adopt(m, &m->down, block, choice);
    price(m, block, choice);
    int16_t *costs = m->down.costs + block * m->path + LANES;
    Words now = load(m->down.least + block * LANES);
    for (int y = 0; y < LANES; y++) {
        ptrdiff_t at = y * columns(m) + (ptrdiff_t)block * LANES;
        now = go_on(choice, costs, now, load(m->leap + at), step, m->cost + y * row,
                    (Use){.taken = kept + y * row, .total = m->total + y * row});
        now = chosen(load(m->where + at), now, all_of(-1));
    }
    store(m->down.least + block * LANES, now);
    for (ptrdiff_t i = 0; i < row; i += LANES) {
        turn(m->cost + i, row, cost_across + i, row);
        turn(m->total + i, row, total_across + i, row);
    }
    adopt(m, &m->across, 0, choice);
    now = load(m->across.least);
    for (int x = 0; x < LANES; x++) {
        ptrdiff_t at = ((ptrdiff_t)block * LANES + x) * LANES;
        now = go_on(choice, m->across.costs + LANES, now, load(m->leap_across + at), step,
                    cost_across + x * row,
                    (Use){.before = total_across + x * row, .total = total_across + x * row});
        now = chosen(load(m->where_across + at), now, all_of(-1));
    }
    store(m->across.least, now);
}

/* Choose the disparities of least cost of a column. ``found``: gets the results, each LANES x LANES
   words after the last one. */
INLINE void choose(const Choice *choice, const int16_t *total, Words where, int with_rivals,
                   int16_t *found)
{
    const Words none = all_of(MAX_COST);
    Words cost = none, best = all_of(0), before = none, after = none;
    const int16_t *at = total;
    for (int i = 0; i < choice->runs; i++) {
        const Run run = choice->run[i];
        Words last = none, less = all_of(0), d = all_of(run.begin);
        for (int k = run.begin; k < run.end; k++) {
            Words here = load(at);
            after = chosen(less, here, after);
            less = here < cost;
            cost = least(cost, here);
            best = chosen(less, d, best);
            before = chosen(less, last, before);
            last = here;
            d += 1;
            at += LANES;
        }
        after = chosen(less, none, after);
    }
    /* Its neighbours do not compete with the best. */
    Words second = none;
    at = total;
    for (int i = 0; i < choice->runs; i++) {
        const Run run = choice->run[i];
        Words away = all_of(run.begin) - best;
        for (int k = run.begin; k < run.end; k++) {
            Words near = least(away, -away) >= -1;
            second = least(second, load(at) | (near & MAX_COST));
            away += 1;
            at += LANES;
        }
    }
    if (with_rivals) {
        Words rival = none;
        at = total;
        for (int i = 0; i < choice->runs; i++) {
            const Run run = choice->run[i];
            Words d = all_of(run.begin);
            for (int k = run.begin; k < run.end; k++) {
                Words away = d - best;
                Words is_other = (load(at) == second) & (least(away, -away) < -1);
                rival = least(rival, chosen(is_other, d, none));
                d += 1;
                at += LANES;
            }
        }
        store(found + RIVAL * LANES * LANES, rival);
    }
    store(found + BEST * LANES * LANES, best | ~where);
    store(found + COST * LANES * LANES, cost);
    store(found + SECOND_COST * LANES * LANES, second);
    store(found + BEFORE * LANES * LANES, before);
    store(found + AFTER * LANES * LANES, after);
}

/* Go to the left in a block, and choose. */
static void block_back(const Matching *m, int block, const Choice *choice,
                       const int16_t *cost_across, const int16_t *total_across, int with_rivals)
{
    Words step = all_of(m->penalties.step), now = load(m->across.least);
    ptrdiff_t row = (ptrdiff_t)choice->count * LANES;
    int16_t found[RESULTS * LANES * LANES];
    adopt(m, &m->across, 0, choice);
    for (int x = LANES - 1; x >= 0; x--) {
        ptrdiff_t at = ((ptrdiff_t)block * LANES + x) * LANES;
        Words where = load(m->where_across + at);
        now = go_on(choice, m->across.costs + LANES, now, load(m->leap_across + at + LANES), step,
                    cost_across + x * row,
                    (Use){.before = total_across + x * row, .total = m->total});
        now = chosen(where, now, all_of(-1));
        choose(choice, m->total, where, with_rivals, found + x * LANES);
    }
    store(m->across.least, now);
    for (int i = 0; i < (with_rivals ? RESULTS : RIVAL); i++)
        turn(found + i * LANES * LANES, LANES, m->found + i * columns(m) + block * LANES,
             RESULTS * columns(m));
}

/* A right pixel's claim to a left one: that of least cost, of equal costs that of the largest
   disparity, whose pixel lies farthest on the left. */
INLINE int claim_of(int cost, int disparity) { return cost << 16 | (MAX_COST - disparity); }
INLINE int disparity_of(int claim) { return MAX_COST - (claim & MAX_COST); }

/* Fill in a row of disparities, between whole px where lines of equal slope meet, and of margins.
   Where they are too small, ``best`` becomes -1. */
static void measure(const Matching *m, const int16_t *found, int16_t *restrict best,
                    float *restrict disparity, float *restrict margin)
{
    ptrdiff_t line = columns(m), width = m->view.width;
    const int16_t *cost = found + COST * line, *second = found + SECOND_COST * line;
    const int16_t *before = found + BEFORE * line, *after = found + AFTER * line;
    int last = m->view.count - 1;
    float share = m->penalties.min_share, least = m->penalties.min_margin;
    for (ptrdiff_t x = 0; x < width; x++) {
        float more = (float)(second[x] - cost[x]), enough = share * (float)second[x];
        enough = enough > least ? enough : least;
        margin[x] = more;
        /* Of a neighbour that was not looked at, the other one's cost. */
        int ahead = before[x] < MAX_COST ? before[x] : after[x] < MAX_COST ? after[x] : cost[x];
        int behind = after[x] < MAX_COST ? after[x] : ahead;
        int below = ahead - cost[x], above = behind - cost[x];
        int larger = below > above ? below : above;
        float apart = (float)(below - above) / (float)(2 * (larger > 1 ? larger : 1));
        int d = best[x];
        disparity[x] = (float)d + (d > 0 && d < last ? apart : 0);
        best[x] = more < enough ? -1 : best[x];
    }
}

/* Fill in a row: what both views agree on. ``rival``: NULL, or gets the second best where it costs
   hardly more, else NaN. */
static void paint(const Matching *m, int16_t *found, float *disparity, float *margin, float *rival)
{
    ptrdiff_t line = columns(m);
    int16_t *best = found + BEST * line;
    const int16_t *cost = found + COST * line, *second = found + SECOND_COST * line;
    int *partner = m->partner, width = m->view.width, before = -2;
    for (int x = 0; x < width + m->view.count; x++)
        partner[x] = INT_MAX;
    for (int x = 0; x < width; x++) {
        int d = best[x], claim = claim_of(cost[x], d);
        int *place = partner + (d < 0 ? width + m->view.count : x + d);
        *place = claim < *place ? claim : *place;
    }
    for (int x = 0; rival && x < width; x++) {
        int is_rival = best[x] >= 0 && second[x] < MAX_COST
                       && (float)(second[x] - cost[x]) < RIVAL_SHARE * second[x];
        rival[x] = is_rival ? (float)found[RIVAL * line + x] : NAN;
    }
    measure(m, found, best, disparity, margin);
    for (int x = 0; x < width; x++) {
        int d = best[x];
        int is_known = d >= 0 && abs(disparity_of(partner[x + d]) - d) <= 1
                       && (x + d < width || abs(before - d) <= 1);
        before = is_known ? d : -2;
        if (!is_known)
            disparity[x] = margin[x] = NAN;
    }
}

/* Go down a band and along its rows, and fill in what is found. */
static void band_down(const Matching *m, int band, const uint8_t *kept, float *disparity,
                      float *margin, float *rival)
{
    ptrdiff_t width = columns(m), offset = 0;
    read_band(m, band);
    for (int y = 0; y < LANES; y++) {
        const uint8_t *here = m->right + (y + 1) * m->line + HALO;
        fill_leaps(m, here, here - 1, m->leap + y * width);
    }
    for (ptrdiff_t x = 0; x < width; x += LANES) {
        turn(m->leap + x, width, m->leap_across + x * LANES, LANES);
        turn(m->where + x, width, m->where_across + x * LANES, LANES);
    }
    for (int y = 0; y < LANES; y++) {
        const uint8_t *here = m->right + (y + 1) * m->line + HALO;
        fill_leaps(m, here, here - m->line, m->leap + y * width);
        for (ptrdiff_t x = 0; x < width; x++)
            m->found[(y * RESULTS + BEST) * width + x] = -1;
    }
    store(m->across.least, all_of(-1));
    for (int block = 0; block < m->blocks; block++) {
        Choice choice;
        choice_of(m, band, block, &choice);
        if (choice.count > 0) {
            block_forward(m, block, &choice, kept + offset, m->cost_across + offset,
                          m->total_across + offset);
            offset += costs_of(&choice);
        } else {
            store(m->across.least, all_of(-1));
            store(m->down.least + block * LANES, all_of(-1));
        }
    }
    store(m->across.least, all_of(-1));
    for (int block = m->blocks - 1; block >= 0; block--) {
        Choice choice;
        choice_of(m, band, block, &choice);
        if (choice.count > 0) {
            offset -= costs_of(&choice);
            block_back(m, block, &choice, m->cost_across + offset, m->total_across + offset,
                       rival != NULL);
        } else
            store(m->across.least, all_of(-1));
    }
    for (int y = 0; y < LANES && band * LANES + y < m->view.rows; y++) {
        ptrdiff_t at = (ptrdiff_t)(band * LANES + y) * m->view.width;
        paint(m, m->found + y * RESULTS * width, disparity + at, margin + at,
              rival ? rival + at : NULL);
    }
}

static ptrdiff_t costs_of_bands(const Matching *m, int first, int end)
{
    ptrdiff_t costs = 0;
    for (int band = first; band < end; band++)
        for (int block = 0; block < m->blocks; block++) {
            Choice choice;
            choice_of(m, band, block, &choice);
            costs += costs_of(&choice);
        }
    return costs;
}

/* Bands of a strip, so that its costs take about as much memory as they may. */
static int bands_of_strip(const Matching *m)
{
    ptrdiff_t bands = m->bands;
    ptrdiff_t bytes = costs_of_bands(m, 0, m->bands);
    ptrdiff_t strips = bytes / m->view.strip_bytes + 1;
    /* What is brought to a strip takes memory, too: more strips than this take more of both. */
    ptrdiff_t brought = (ptrdiff_t)sizeof(int16_t) * m->blocks * m->path;
    while (strips * (strips - 1) * brought > bytes)
        strips--;
    strips = strips < bands ? strips : bands;
    return (int)((bands + strips - 1) / strips);
}

static void begin(const Matching *m, int blocks, const Paths *paths)
{
    for (ptrdiff_t i = 0; i < blocks * m->path; i++)
        paths->costs[i] = OUTSIDE;
    for (int i = 0; i < blocks * LANES; i++)
        paths->least[i] = -1;
    memset(paths->sets, 0, (size_t)blocks * sizeof(Set));
}

static void copy(const Matching *m, const Paths *from, const Paths *to)
{
    size_t blocks = (size_t)m->blocks;
    memcpy(to->costs, from->costs, blocks * (size_t)m->path * sizeof(int16_t));
    memcpy(to->least, from->least, blocks * LANES * sizeof(int16_t));
    memcpy(to->sets, from->sets, blocks * sizeof(Set));
}

static int end_of_strip(const Matching *m, int first)
{
    return first + m->strip_bands < m->bands ? first + m->strip_bands : m->bands;
}

/* Go up the bands of a strip. */
static void strip_up(const Matching *m, int first, int end)
{
    ptrdiff_t offset = costs_of_bands(m, first, end);
    for (int band = end - 1; band >= first; band--) {
        offset -= costs_of_bands(m, band, band + 1);
        band_up(m, band, m->kept + offset);
    }
}

#define TAKE(array, number)                                              \
    array = (void *)*memory;                                             \
    *memory += ((number) * sizeof(*array) + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;

/* Where the paths of some blocks lie in memory; moves it on behind them. */
static Paths paths_in(const Matching *m, int blocks, uint8_t **memory)
{
    Paths paths;
    TAKE(paths.costs, (size_t)blocks * (size_t)m->path)
    TAKE(paths.least, (size_t)blocks * LANES)
    TAKE(paths.sets, (size_t)blocks)
    return paths;
}

/* Lay out the workspace; return where it ends. */
static uint8_t *lay_out(Matching *m, uint8_t *start)
{
    uint8_t *position = start, **memory = &position;
    size_t lines = LINES * (size_t)m->line, pixels = (size_t)columns(m) * LANES;
    TAKE(m->right, lines)
    TAKE(m->lean, lines)
    TAKE(m->grey, (size_t)m->line + 2 * LANES)
    TAKE(m->low, lines)
    TAKE(m->high, lines)
    TAKE(m->slope, lines)
    TAKE(m->where, pixels)
    TAKE(m->where_across, pixels)
    TAKE(m->weight, pixels)
    TAKE(m->wanted, pixels)
    TAKE(m->leap, pixels)
    TAKE(m->leap_across, pixels + LANES)
    TAKE(m->found, RESULTS * pixels)
    TAKE(m->partner, (size_t)(m->view.width + m->view.count) + 1)
    m->down = paths_in(m, m->blocks, memory);
    m->across = paths_in(m, 1, memory);
    size_t block = 0, band = 0, strip = 0;
    m->strip_bands = bands_of_strip(m);
    m->brought = position;
    for (int first = 0; first < m->bands; first += m->strip_bands) {
        int end = end_of_strip(m, first);
        size_t more = (size_t)costs_of_bands(m, first, end);
        strip = strip > more ? strip : more;
        for (int each = first; each < end; each++) {
            size_t words = (size_t)costs_of_bands(m, each, each + 1);
            band = band > words ? band : words;
        }
        paths_in(m, m->blocks, memory);
    }
    block = (size_t)m->view.count * LANES * LANES;
    TAKE(m->sums, 2 * LANES * LANES)
    TAKE(m->cost, block)
    TAKE(m->total, block)
    TAKE(m->cost_across, band)
    TAKE(m->total_across, band)
    TAKE(m->kept, strip)
    return position;
}

/* What the path from below brings to the strip from band ``first`` on. */
static Paths brought_to(const Matching *m, int first)
{
    uint8_t *memory = m->brought;
    for (; first >= m->strip_bands; first -= m->strip_bands)
        paths_in(m, m->blocks, &memory);
    return paths_in(m, m->blocks, &memory);
}

static Matching matching_of(View view, Penalties penalties, Tiles tiles)
{
    Matching m = {.view = view, .penalties = penalties, .tiles = tiles};
    m.blocks = (view.width + LANES - 1) / LANES;
    m.bands = (view.rows + LANES - 1) / LANES;
    m.line = (HALO + columns(&m) + view.count + 4 * LANES - 1) / (2 * LANES) * (2 * LANES);
    m.path = (ptrdiff_t)(view.count + 2) * LANES;
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
    begin(m, m->blocks, &m->down);
    begin(m, 1, &m->across);
    int first = (m->bands - 1) / m->strip_bands * m->strip_bands;
    m->up = brought_to(m, first);
    begin(m, m->blocks, &m->up);
    for (; first > 0; first -= m->strip_bands) {
        Paths before = m->up;
        m->up = brought_to(m, first - m->strip_bands);
        copy(m, &before, &m->up);
        strip_up(m, first, end_of_strip(m, first));
    }
    for (; first < m->bands; first += m->strip_bands) {
        int end = end_of_strip(m, first);
        ptrdiff_t offset = 0;
        m->up = brought_to(m, first);
        strip_up(m, first, end);
        for (int band = first; band < end; band++) {
            band_down(m, band, m->kept + offset, disparity, margin, rival);
            offset += costs_of_bands(m, band, band + 1);
        }
    }
}

#endif
