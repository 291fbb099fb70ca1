/* Plane sweep through several images: census costs (Zabih & Woodfill 1994),
 * the worst views dropped at each plane, semi-global aggregation (Hirschmueller 2008).
 *
 * Images are uchar, row-major. Census words have 24 bits of a 5 x 5 window. A grid pixel (x, y) is
 * image pixel stride * (x, y). Plane k lies at inverse depth rho0 + k * step. Costs are uchar, sums ushort,
 * both in vectors of 16 planes; those of a pixel begin at vector first[y][x].
 *
 * Vectors are read through pointers and compared with ?: because some compilers make calls, and slow
 * ones, of vloadn, min and max.
 */

#if !defined(PLANES)
#error "PLANES must be defined, a multiple of 16, at most 256"
#endif
#define BLOCK 8
/* As in companion/dense/view_selection.py. */
#define MAX_VIEWS 6
#define BLOCKS (PLANES / BLOCK)
#define LANES (PLANES / 16)
/* Of the vectors of 16 planes, two blocks, only those are stored in which a block is wanted. */
#define IS_WANTED(blocks, vector) ((blocks) >> 2 * (vector) & 3)
/* Expected difference of unrelated patches, of 24 bits. */
#ifndef UNRELATED
#define UNRELATED 12
#endif

typedef uchar8 uchar8_anywhere __attribute__((aligned(1)));
typedef uint8 uint8_anywhere __attribute__((aligned(4)));

static int inside(int value, int high)
{
    return value < 0 ? 0 : value > high ? high : value;
}

/* Words of an image, from out[first] on. Grid: (width + 7) / 8 x height; a work-item does 8 pixels.
 * Beyond the border the image repeats. */
__kernel void census(__global const uchar *image, const int width, const int height,
                     __global uint *words, const int first)
{
    const int x0 = 8 * get_global_id(0), y = get_global_id(1);
    if (x0 >= width || y >= height)
        return;
    __global uint *out = words + first;
    if (x0 >= 2 && x0 + 10 <= width && y >= 2 && y + 2 < height) {
        __global const uchar *at = image + y * width + x0;
        const uchar8 centre = *(__global const uchar8_anywhere *)at;
        uchar8 part[3] = {0, 0, 0};
#pragma unroll
        for (int n = 0; n < 24; ++n) {
            const int m = n < 12 ? n : n + 1;
            const uchar8 other = *(__global const uchar8_anywhere *)(at + (m / 5 - 2) * width + m % 5 - 2);
            part[n / 8] |= as_uchar8(other > centre) & (uchar8)(1 << n % 8);
        }
        *(__global uint8_anywhere *)(out + y * width + x0) = convert_uint8(part[0])
                                                             | convert_uint8(part[1]) << 8
                                                             | convert_uint8(part[2]) << 16;
        return;
    }
    for (int x = x0; x < x0 + 8 && x < width; ++x) {
        const uchar centre = image[y * width + x];
        uint word = 0;
        int n = 0;
        for (int j = -2; j <= 2; ++j)
            for (int i = -2; i <= 2; ++i) {
                const int v = inside(y + j, height - 1), u = inside(x + i, width - 1);
                if (i != 0 || j != 0)
                    word |= (uint)(image[v * width + u] > centre) << n++;
            }
        out[y * width + x] = word;
    }
}

/* Number of bits set in each of 8 words of 24 bits. */
static int8 count(uint8 bits)
{
    bits = bits - ((bits >> 1) & 0x55555555u);
    bits = (bits & 0x33333333u) + ((bits >> 2) & 0x33333333u);
    bits = (bits + (bits >> 4)) & 0x0f0f0f0fu;
    return as_int8((bits + (bits >> 8) + (bits >> 16)) & 0x1fu);
}

static uint8 gathered(__global const uint *words, int8 at)
{
    return (uint8)(words[at.s0], words[at.s1], words[at.s2], words[at.s3], words[at.s4], words[at.s5],
                   words[at.s6], words[at.s7]);
}

/* Differing bits between a word and the words at the projections of 8 planes, all of them seen. */
static int8 differing(__global const uint *words, uint word, float8 rho, float4 base, float4 shift, int width)
{
    const float8 scale = 1.0f / (base.z + rho * shift.z);
    const float8 x = (base.x + rho * shift.x) * scale + 0.5f, y = (base.y + rho * shift.y) * scale + 0.5f;
    return count(gathered(words, convert_int8(y) * width + convert_int8(x)) ^ word);
}

/* The same where some are outside: there UNRELATED, and one more in `unseen`. */
static int8 differing_in_part(__global const uint *words, uint word, float8 rho, float4 base, float4 shift,
                              int width, int height, int8 *unseen)
{
    const float8 z = base.z + rho * shift.z;
    const float8 scale = 1.0f / z;
    const float8 x = (base.x + rho * shift.x) * scale + 0.5f, y = (base.y + rho * shift.y) * scale + 0.5f;
    const int8 seen = (z > 1e-6f) & (x >= 0.0f) & (x < (float)width) & (y >= 0.0f) & (y < (float)height);
    /* invisible projections may overflow an int */
    const float8 safe_x = seen ? x : 0.0f, safe_y = seen ? y : 0.0f;
    const int8 at = convert_int8(safe_y) * width + convert_int8(safe_x);
    *unseen += seen ? (int8)0 : (int8)1;
    return seen ? count(gathered(words, at) ^ word) : (int8)UNRELATED;
}

/* Whether a point is seen at this inverse depth, a pixel or more from the border. */
static bool well_inside(float4 base, float4 shift, float rho, int width, int height)
{
    const float z = base.z + rho * shift.z;
    const float x = (base.x + rho * shift.x) / z, y = (base.y + rho * shift.y) / z;
    return z > 1e-3f && x >= 1.0f && y >= 1.0f && x <= width - 2.0f && y <= height - 2.0f;
}

/* Costs of a grid pixel at the planes of the blocks that it is given. Of two blocks that are one vector
 * in what follows, one that is not given costs `elsewhere`.
 *   words_r, words  census of the reference and, one after the other, of n_views images
 *   views           per image 12 numbers: rows of (3 x 3 | 3), pixel (x, y) at inverse depth rho is
 *                   seen at (M (x, y, 1) + rho m), to be divided by its third component
 *   blocks, first   per grid pixel a bit for each block of 8 planes, and its place in `cost`
 *   n_dropped       worst views dropped at each plane: 0, 1 or 2
 * Where fewer views see a plane than should count, their mean substitutes the others: otherwise
 * planes seen by more views would be favoured. A view that sees the first and the last plane sees all
 * between them, as images are convex. */
__kernel void costs(__global const uint *words_r, __global const uint *words, const int width,
                    const int height, __global const float *views, const int n_views,
                    const int n_dropped, const float rho0, const float step,
                    __global const uint *blocks, __global const uint *first, const int elsewhere,
                    __global uchar *cost, const int grid_width, const int grid_height, const int stride)
{
    const int gx = get_global_id(0), gy = get_global_id(1);
    if (gx >= grid_width || gy >= grid_height)
        return;
    const int cell = gy * grid_width + gx;
    const float x = gx * stride, y = gy * stride;
    const uint word = words_r[gy * stride * width + gx * stride];
    const uint wanted = blocks[cell];
    const float8 lane = (float8)(0, 1, 2, 3, 4, 5, 6, 7);
    __global uchar8 *out = (__global uchar8 *)cost + 2 * first[cell];
    float4 base[MAX_VIEWS], shift[MAX_VIEWS];
    uint whole = 0;
    for (int k = 0; k < n_views; ++k) {
        __global const float *m = views + 12 * k;
        base[k] = (float4)(m[0] * x + m[1] * y + m[2], m[4] * x + m[5] * y + m[6],
                           m[8] * x + m[9] * y + m[10], 0.0f);
        shift[k] = (float4)(m[3], m[7], m[11], 0.0f);
        whole |= (uint)(well_inside(base[k], shift[k], rho0, width, height)
                        && well_inside(base[k], shift[k], rho0 + step * (PLANES - 1), width, height)) << k;
    }
    for (int b = 0; b < BLOCKS; ++b) {
        if (!IS_WANTED(wanted, b / 2))
            continue;
        if (!(wanted >> b & 1)) {
            *out++ = (uchar8)elsewhere;
            continue;
        }
        const float8 rho = rho0 + step * (lane + (float)(BLOCK * b));
        int8 sum = 0, worst = 0, second = 0, unseen = 0;
        for (int k = 0; k < n_views; ++k) {
            __global const uint *at = words + (size_t)k * width * height;
            const int8 bits = whole >> k & 1
                                  ? differing(at, word, rho, base[k], shift[k], width)
                                  : differing_in_part(at, word, rho, base[k], shift[k], width, height, &unseen);
            sum += bits;
            const int8 lesser = worst < bits ? worst : bits;
            worst = worst > bits ? worst : bits;
            second = second > lesser ? second : lesser;
        }
        int8 least = n_dropped == 0 ? sum : n_dropped == 1 ? sum - worst : sum - worst - second;
        const int8 few = (unseen > n_dropped) & (unseen < n_views);
        if (any(few)) {
            const float8 out_of_sight = convert_float8(unseen), seen = (float)n_views - out_of_sight;
            const float8 mean = (convert_float8(sum) - UNRELATED * out_of_sight) / (seen > 1.0f ? seen : 1.0f);
            const int8 all = convert_int8(mean * (float)(n_views - n_dropped) + 0.5f);
            least = few ? all : least;
        }
        *out++ = convert_uchar8(least);
    }
}

static uchar lowest(uchar16 v)
{
    const uchar8 a = v.lo < v.hi ? v.lo : v.hi;
    const uchar4 b = a.lo < a.hi ? a.lo : a.hi;
    const uchar2 c = b.lo < b.hi ? b.lo : b.hi;
    return c.x < c.y ? c.x : c.y;
}

/* Adds one direction (dx, dy) of paths to the sums, or begins them. Grid: a work-item for each path:
 * each row where dy is 0, else each column; a diagonal path that leaves at one side continues at
 * the other. small: penalty of a step by one plane; large: of any other, less where the image has an edge
 * of many times `soft` grey levels. No cost may be above 255 - small - large. A
 * plane that is not stored ends paths, as those beyond the first and the last do. */
__kernel void aggregate(__global const uchar *cost, __global const uint *blocks, __global const uint *first,
                        __global ushort *sum, __global const uchar *image, const int width,
                        const int grid_width, const int grid_height, const int stride, const int dx,
                        const int dy, const int small, const int large, const int soft, const int begin)
{
    const int item = get_global_id(0);
    if (item >= (dy ? grid_width : grid_height))
        return;
    const int n = dy ? grid_height : grid_width;
    int x = dy ? item : dx > 0 ? 0 : grid_width - 1;
    int y = !dy ? item : dy > 0 ? 0 : grid_height - 1;
    uchar16 path[LANES];
    for (int b = 0; b < LANES; ++b)
        path[b] = 0;
    const uchar16 one = (uchar)small;
    const uchar beyond = 255 - small;
    int low = 0, last = 0, fresh = 1;
    for (int k = 0; k < n; ++k) {
        const int cell = y * grid_width + x;
        const uint wanted = blocks[cell];
        __global const uchar16 *here = (__global const uchar16 *)cost + first[cell];
        __global ushort16 *total = (__global ushort16 *)sum + first[cell];
        const int grey = image[y * stride * width + x * stride];
        const int edge = grey > last ? grey - last : last - grey;
        const int reduced = large * soft / (soft + edge);
        last = grey;
        const int jump = low + (reduced > small ? reduced : small);
        const uchar16 any = (uchar)(fresh ? 0 : jump < 255 ? jump : 255);
        const uchar16 level = (uchar)low;
        uchar16 lows = 255;
        uchar below = beyond;
#pragma unroll
        for (int b = 0; b < LANES; ++b) {
            const uchar16 v = path[b];
            if (!IS_WANTED(wanted, b)) {
                path[b] = beyond;
                below = v.sf;
                continue;
            }
            const uchar above = b + 1 < LANES ? path[b + 1].s0 : beyond;
            const uchar16 left = (uchar16)(below, v.s0, v.s1, v.s2, v.s3, v.s4, v.s5, v.s6, v.s7, v.s8,
                                           v.s9, v.sa, v.sb, v.sc, v.sd, v.se);
            const uchar16 right = (uchar16)(v.s1, v.s2, v.s3, v.s4, v.s5, v.s6, v.s7, v.s8, v.s9, v.sa,
                                            v.sb, v.sc, v.sd, v.se, v.sf, above);
            const uchar16 side = (left < right ? left : right) + one;
            uchar16 best = v < any ? v : any;
            best = best < side ? best : side;
            const uchar16 now = *here++ + (best - level);
            below = v.sf;
            path[b] = now;
            lows = lows < now ? lows : now;
            const ushort16 wide = convert_ushort16(now);
            *total = begin ? wide : *total + wide;
            ++total;
        }
        low = lowest(lows);
        fresh = 0;
        x += dx;
        y += dy;
        if (dy && (x < 0 || x >= grid_width)) {
            x = x < 0 ? grid_width - 1 : 0;
            for (int b = 0; b < LANES; ++b)
                path[b] = 0;
            low = 0;
            fresh = 1;
        }
    }
}

static ushort lowest16(ushort16 v)
{
    const ushort8 a = v.lo < v.hi ? v.lo : v.hi;
    const ushort4 b = a.lo < a.hi ? a.lo : a.hi;
    const ushort2 c = b.lo < b.hi ? b.lo : b.hi;
    return c.x < c.y ? c.x : c.y;
}

/* Inverse depth of the plane of minimum sum, refined by a parabola; and the relative excess of the
 * best plane more than two away, at most that of `most`; both among the vectors that are wanted. Grid: one
 * work-item per grid pixel. */
__kernel void winner(__global const ushort *sum, __global const uint *blocks, __global const uint *first,
                     const int n, const float rho0, const float step, const int most, __global float *rho,
                     __global float *margin)
{
    const int cell = get_global_id(0);
    if (cell >= n)
        return;
    const uint wanted = blocks[cell];
    __global const ushort16 *wide = (__global const ushort16 *)sum + first[cell];
    ushort best = 65535;
    int at = 0, found = 0;
    for (int b = 0, k = 0; b < LANES; ++b)
        if (IS_WANTED(wanted, b)) {
            const ushort low = lowest16(wide[k]);
            at = low < best ? 16 * b : at;
            found = low < best ? 16 * k : found;
            best = low < best ? low : best;
            ++k;
        }
    /* among the sums of this pixel; its neighbours there are those among the planes, where these are stored */
    __global const ushort *s = (__global const ushort *)wide + found;
    int off = 0;
    while (off < 15 && s[off] != best)
        ++off;
    at += off;
    const ushort16 lane = (ushort16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    ushort16 others = (ushort)most;
    for (int b = 0, k = 0; b < LANES; ++b)
        if (IS_WANTED(wanted, b)) {
            /* unsigned: what lies below the band wraps round to far above it */
            const ushort16 away = lane + (ushort)(16 * b + 2 - at);
            const ushort16 v = away <= (ushort)4 ? (ushort16)65535 : wide[k];
            others = others < v ? others : v;
            ++k;
        }
    const ushort second = lowest16(others);
    float shift = 0.0f;
    if (at > 0 && at < PLANES - 1 && IS_WANTED(wanted, (at - 1) / 16) && IS_WANTED(wanted, (at + 1) / 16)) {
        const float before = s[off - 1], after = s[off + 1], bend = before + after - 2.0f * best;
        shift = bend > 0.0f ? 0.5f * (before - after) / bend : 0.0f;
    }
    rho[cell] = rho0 + step * (at + shift);
    margin[cell] = (float)(second - best) / (best + 1.0f);
}

/* Blocks of planes to evaluate for a fine grid pixel: those around the planes of the surrounding
 * coarse grid pixels, among those allowed. Grid: fine pixels. */
__kernel void blocks_about(__global const float *rho, const int coarse_width, const int coarse_height,
                           const float rho0, const float step, const uint allowed,
                           __global uint *blocks,
                           const int grid_width, const int grid_height)
{
    const int gx = get_global_id(0), gy = get_global_id(1);
    if (gx >= grid_width || gy >= grid_height)
        return;
    const int cx = (gx + 1) / 2, cy = (gy + 1) / 2;
    const float per_plane = 1.0f / step;
    uint bits = 0;
    for (int j = -2; j <= 1; ++j)
        for (int i = -2; i <= 1; ++i) {
            const float value = rho[inside(cy + j, coarse_height - 1) * coarse_width
                                    + inside(cx + i, coarse_width - 1)];
            const int plane = (int)((value - rho0) * per_plane + 0.5f);
            bits |= 1u << inside(plane - 2, PLANES - 1) / BLOCK;
            bits |= 1u << inside(plane + 2, PLANES - 1) / BLOCK;
        }
    blocks[gy * grid_width + gx] = bits & allowed;
}

/* Places of the vectors of each grid pixel, one pixel after the other along a row. Grid: rows. */
__kernel void places(__global const uint *blocks, __global uint *first, const int grid_width, const int grid_height)
{
    const int y = get_global_id(0);
    if (y >= grid_height)
        return;
    uint at = (uint)y * grid_width * LANES;
    for (int x = 0; x < grid_width; ++x) {
        const uint wanted = blocks[y * grid_width + x];
        first[y * grid_width + x] = at;
        at += popcount((wanted | wanted >> 1) & 0x55555555u);
    }
}

/* Median of 3 x 3, and the local noise as one standard deviation: from second differences, which
 * are insensitive to slope. Grid: width x height. */
__kernel void median(__global const float *in, const int width, const int height, __global float *out,
                     __global float *noise)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height)
        return;
    float v[9];
    for (int j = 0; j < 3; ++j)
        for (int i = 0; i < 3; ++i)
            v[3 * j + i] = in[inside(y + j - 1, height - 1) * width + inside(x + i - 1, width - 1)];
    /* for independent noise the mean |second difference| is 1.95 standard deviations */
    noise[y * width + x] = (fabs(v[0] + v[8] - 2 * v[4]) + fabs(v[1] + v[7] - 2 * v[4])
                            + fabs(v[2] + v[6] - 2 * v[4]) + fabs(v[3] + v[5] - 2 * v[4])) / (4 * 1.95f);
#define SORT(a, b) { const float low = v[a] < v[b] ? v[a] : v[b]; v[b] = v[a] < v[b] ? v[b] : v[a]; v[a] = low; }
    SORT(1, 2) SORT(4, 5) SORT(7, 8) SORT(0, 1) SORT(3, 4) SORT(6, 7) SORT(1, 2) SORT(4, 5) SORT(7, 8)
    SORT(0, 3) SORT(5, 8) SORT(4, 7) SORT(3, 6) SORT(1, 4) SORT(2, 5) SORT(4, 7) SORT(4, 2) SORT(6, 4)
    SORT(4, 2)
#undef SORT
    out[y * width + x] = v[4];
}
