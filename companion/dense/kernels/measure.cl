/* Photo-consistency of the images with the swept depth, and classification of the pixels.
 *
 * An image is sampled at the projection of every grid pixel by its own inverse depth, half a pixel
 * before and behind along its epipolar line, so that a window of samples follows a slanted surface.
 * Over a 5 x 5 window the reference is then fitted by gain * value + slope * change +
 * offset (Lucas & Kanade 1981 in one dimension, with gain): slope / gain is the
 * disparity error in pixels.
 */

#define WINDOW 2
#define AREA 25.0f
#define UNSEEN -1e4f
/* Weight of the noise of neighbours. */
#define ROUGH 1.0f

typedef float8 float8_anywhere __attribute__((aligned(4)));

typedef ushort ushort_anywhere __attribute__((aligned(1)));

/* Two pixels beside each other, at 8 places; the left one in the lower byte, as devices are little-endian. */
static uint8 pairs(__global const uchar *image, int8 at)
{
#define PAIR(i) *(__global const ushort_anywhere *)(image + at.s##i)
    return (uint8)(PAIR(0), PAIR(1), PAIR(2), PAIR(3), PAIR(4), PAIR(5), PAIR(6), PAIR(7));
#undef PAIR
}

static float8 bilinear(__global const uchar *image, int width, float8 x, float8 y)
{
    const int8 ix = convert_int8(x), iy = convert_int8(y), at = iy * width + ix;
    const float8 fx = x - convert_float8(ix), fy = y - convert_float8(iy);
    const uint8 above = pairs(image, at), below = pairs(image, at + width);
    const float8 a = convert_float8(above & 255u), b = convert_float8(below & 255u);
    const float8 top = a + fx * (convert_float8(above >> 8) - a);
    const float8 bottom = b + fx * (convert_float8(below >> 8) - b);
    return top + fy * (bottom - top);
}

/* Value and change along the epipolar line at each grid pixel's projection; unseen: value UNSEEN.
 * Grid: (grid_width + 7) / 8 x grid_height, 8 pixels each. m: rows of (3 x 3 | 3), as for costs. */
__kernel void follow(__global const uchar *image, const int width, const int height,
                     __global const float *rho, const float4 m0, const float4 m1, const float4 m2,
                     __global float *value, __global float *change,
                     const int grid_width, const int grid_height, const int stride)
{
    const int gx = 8 * get_global_id(0), gy = get_global_id(1);
    if (gx >= grid_width || gy >= grid_height)
        return;
    const int cell = gy * grid_width + gx, n = grid_width - gx;
    float8 r = 0.0f;
    if (n >= 8)
        r = *(__global const float8_anywhere *)(rho + cell);
    else
        for (int k = 0; k < n; ++k)
            ((float *)&r)[k] = rho[cell + k];
    const float8 x = convert_float8((int8)(0, 1, 2, 3, 4, 5, 6, 7) + gx) * (float)stride;
    const float y = gy * stride;
    const float8 qx = m0.x * x + (m0.y * y + m0.z) + r * m0.w, qy = m1.x * x + (m1.y * y + m1.z) + r * m1.w;
    const float8 qz = m2.x * x + (m2.y * y + m2.z) + r * m2.w;
    const float8 scale = 1.0f / (qz > 1e-6f ? qz : 1e-6f);
    const float8 u = qx * scale, v = qy * scale;
    const float8 du = (m0.w - u * m2.w) * scale, dv = (m1.w - v * m2.w) * scale;
    const float8 square = du * du + dv * dv;
    const float8 half_ = 0.5f / sqrt(square > 1e-18f ? square : 1e-18f);
    const float8 eu = du * half_, ev = dv * half_;
    const int8 seen = (qz > 1e-6f) & (u >= 1.0f) & (v >= 1.0f) & (u < width - 2.0f) & (v < height - 2.0f);
    const float8 su = seen ? u : 1.0f, sv = seen ? v : 1.0f;
    const float8 nearer = bilinear(image, width, seen ? su - eu : su, seen ? sv - ev : sv);
    const float8 farther = bilinear(image, width, seen ? su + eu : su, seen ? sv + ev : sv);
    const float8 mean = seen ? 0.5f * (nearer + farther) : UNSEEN, difference = farther - nearer;
    if (n >= 8) {
        *(__global float8_anywhere *)(value + cell) = mean;
        *(__global float8_anywhere *)(change + cell) = difference;
        return;
    }
    for (int k = 0; k < n; ++k) {
        value[cell + k] = ((const float *)&mean)[k];
        change[cell + k] = ((const float *)&difference)[k];
    }
}

/* The reference image on the grid, as float. */
__kernel void to_grid(__global const uchar *image, const int width, __global float *out,
                      const int grid_width, const int grid_height, const int stride)
{
    const int gx = get_global_id(0), gy = get_global_id(1);
    if (gx < grid_width && gy < grid_height)
        out[gy * grid_width + gx] = image[gy * stride * width + gx * stride];
}

/* Counts consistent images per grid pixel, one image at a time. Grid: (grid_width + 7) / 8 x grid_height, 8
 * pixels each; not computed on a border of two pixels, nor on grids narrower than 12 pixels.
 *   good, bad  images that are consistent, and that are not; blank windows count as neither
 *   alike      inconsistent images whose difference is within the noise
 *   limits     least correlation; grey levels below which a window is blank; largest offset in pixels; sum
 *              of squared differences within the noise */
__kernel void verify(__global const float *reference, __global const float *value,
                     __global const float *change, __global float *good, __global float *bad,
                     __global float *alike, const float4 limits, const int grid_width, const int grid_height)
{
    int x = 8 * get_global_id(0);
    const int y = get_global_id(1);
    if (x >= grid_width || y < WINDOW || y >= grid_height - WINDOW || grid_width < 12)
        return;
    /* the last work-item of a row overlaps its neighbour, and does not write its pixels */
    const int last = grid_width - WINDOW - 8, first = x < WINDOW ? WINDOW : x;
    x = first < last ? first : last;
    const int8 lane = (int8)(0, 1, 2, 3, 4, 5, 6, 7) + x;
    const int8 mine = (lane >= first) & (lane < 8 * (int)get_global_id(0) + 8);
    const int cell = y * grid_width + x;
    float8 s_t = 0, s_w = 0, s_d = 0, tt = 0, ww = 0, dd = 0, tw = 0, td = 0, wd = 0;
    float8 least = 0;
    const float8 t0 = *(__global const float8_anywhere *)(reference + cell);
    const float8 w0 = *(__global const float8_anywhere *)(value + cell);
#pragma unroll
    for (int j = -WINDOW; j <= WINDOW; ++j) {
#pragma unroll
        for (int i = -WINDOW; i <= WINDOW; ++i) {
            const int at = cell + j * grid_width + i;
            const float8 raw = *(__global const float8_anywhere *)(value + at);
            /* relative to the grey level of the centre, for float32 accuracy */
            const float8 t = *(__global const float8_anywhere *)(reference + at) - t0, w = raw - w0;
            const float8 d = *(__global const float8_anywhere *)(change + at);
            least = least < raw ? least : raw;
            s_t += t;
            s_w += w;
            s_d += d;
            tt += t * t;
            ww += w * w;
            dd += d * d;
            tw += t * w;
            td += t * d;
            wd += w * d;
        }
    }
    tt -= s_t * s_t / AREA;
    ww -= s_w * s_w / AREA;
    dd -= s_d * s_d / AREA;
    tw -= s_t * s_w / AREA;
    td -= s_t * s_d / AREA;
    wd -= s_w * s_d / AREA;
    const float8 tiny = 1e-3f;
    const float8 safe_ww = ww > tiny ? ww : tiny, safe_tt = tt > tiny ? tt : tiny;
    const float8 free_d = dd - wd * wd / safe_ww;
    const float8 safe_d = free_d > tiny ? free_d : tiny;
    float8 slope = (td - tw * wd / safe_ww) / safe_d;
    slope = free_d > tiny ? slope : 0.0f;
    const float8 gain = (tw - slope * wd) / safe_ww;
    const float8 explained = gain * tw + slope * td;
    const float8 way = slope / (gain > 0.1f ? gain : 0.1f);
    const float noise = limits.y * limits.y;
    const int8 seen = mine & (least > 0.1f * UNSEEN) & (tt > AREA * noise);
    const int8 fits = seen & (explained > limits.x * limits.x * tt) & (gain > 0.25f) & (gain < 4.0f)
                      & (way < limits.z) & (way > -limits.z);
    const float8 zero = 0.0f, one = 1.0f;
    const float8 more_good = fits ? one : zero, more_bad = (seen & ~fits) ? one : zero;
    /* clamped at 0: negative values are rounding errors */
    const float8 more_alike = (seen & ~fits & (tt + ww - 2.0f * tw < limits.w)) ? one : zero;
    if (x == 8 * (int)get_global_id(0)) {
        *(__global float8_anywhere *)(good + cell) += more_good;
        *(__global float8_anywhere *)(bad + cell) += more_bad;
        *(__global float8_anywhere *)(alike + cell) += more_alike;
        return;
    }
    /* at the ends of a row another work-item writes some of these eight */
    const float more[24] = {more_good.s0, more_good.s1, more_good.s2, more_good.s3,
                            more_good.s4, more_good.s5, more_good.s6, more_good.s7,
                            more_bad.s0, more_bad.s1, more_bad.s2, more_bad.s3,
                            more_bad.s4, more_bad.s5, more_bad.s6, more_bad.s7,
                            more_alike.s0, more_alike.s1, more_alike.s2, more_alike.s3,
                            more_alike.s4, more_alike.s5, more_alike.s6, more_alike.s7};
    for (int k = 0; k < 8; ++k)
        if (x + k >= first && x + k < 8 * (int)get_global_id(0) + 8) {
            good[cell + k] += more[k];
            bad[cell + k] += more[8 + k];
            alike[cell + k] += more[16 + k];
        }
}

/* Standard deviation, inlier ratio, label and the regulariser's weight of each grid pixel. Labels: 0
 * updating, 1 converged, 2 diverged, 3 border.
 *   step    between planes, in inverse depth
 *   accept  relative sigma of a converged pixel; its least inlier ratio; inlier ratio below which one
 *           has diverged; images that must fit
 * The error of a winner was found to be 0.15 planes where it stands out, and 0.2 planes / margin where
 * it does not, whatever the scene (docs/dense_depth.md). */
__kernel void judge(__global const float *rho, __global const float *margin, __global const float *good,
                    __global const float *bad, __global const float *alike, __global const float *noise,
                    const float step, const float4 accept, const int border,
                    __global float *sigma, __global float *ratio, __global uchar *label,
                    __global float *weight, const int grid_width, const int grid_height)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= grid_width || y >= grid_height)
        return;
    const int cell = y * grid_width + x;
    const float r = rho[cell], g = good[cell], b = bad[cell], a = alike[cell];
    const float unsure = 0.2f / (margin[cell] > 0.01f ? margin[cell] : 0.01f);
    const float rough = ROUGH * noise[cell] / step;
    const float s = step * sqrt(0.0225f + unsure * unsure + rough * rough);
    /* differences within the noise neither reject a pixel nor add to its weight */
    const float share = (g + a + 1.0f) / (g + b + 2.0f), correlated = (g + 1.0f) / (g + b + 2.0f);
    const bool outer = x < border || y < border || x >= grid_width - border || y >= grid_height - border;
    const bool done = g + a >= accept.w && share >= accept.y && s < accept.x * r;
    sigma[cell] = s;
    ratio[cell] = share;
    label[cell] = outer ? 3 : done ? 1 : share < accept.z ? 2 : 0;
    const float precision = 0.01f * r / s;
    const float w = precision * precision;
    weight[cell] = (w < 4.0f ? w : 4.0f) * correlated;
}
