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

static float bilinear(__global const uchar *image, int width, float x, float y)
{
    const int ix = (int)x, iy = (int)y;
    const float fx = x - ix, fy = y - iy;
    __global const uchar *p = image + iy * width + ix;
    const float top = p[0] + fx * ((float)p[1] - p[0]);
    const float bottom = p[width] + fx * ((float)p[width + 1] - p[width]);
    return top + fy * (bottom - top);
}

/* Value and change along the epipolar line at each grid pixel's projection; unseen: value UNSEEN.
 * Grid: grid pixels. m: rows of (3 x 3 | 3), as for costs. */
__kernel void follow(__global const uchar *image, const int width, const int height,
                     __global const float *rho, const float4 m0, const float4 m1, const float4 m2,
                     __global float *value, __global float *change,
                     const int grid_width, const int grid_height, const int stride)
{
    const int gx = get_global_id(0), gy = get_global_id(1);
    if (gx >= grid_width || gy >= grid_height)
        return;
    const int cell = gy * grid_width + gx;
    const float x = gx * stride, y = gy * stride, r = rho[cell];
    const float qx = m0.x * x + m0.y * y + m0.z + r * m0.w, qy = m1.x * x + m1.y * y + m1.z + r * m1.w;
    const float qz = m2.x * x + m2.y * y + m2.z + r * m2.w;
    const float scale = 1.0f / (qz > 1e-6f ? qz : 1e-6f);
    const float u = qx * scale, v = qy * scale;
    const float du = (m0.w - u * m2.w) * scale, dv = (m1.w - v * m2.w) * scale;
    const float length_ = sqrt(du * du + dv * dv), half_ = 0.5f / (length_ > 1e-9f ? length_ : 1e-9f);
    const float eu = du * half_, ev = dv * half_;
    const bool seen = qz > 1e-6f && u >= 1.0f && v >= 1.0f && u < width - 2.0f && v < height - 2.0f;
    const float su = seen ? u : 1.0f, sv = seen ? v : 1.0f;
    const float before = bilinear(image, width, su - eu, sv - ev);
    const float behind = bilinear(image, width, su + eu, sv + ev);
    value[cell] = seen ? 0.5f * (before + behind) : UNSEEN;
    change[cell] = behind - before;
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
