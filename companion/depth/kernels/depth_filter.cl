/* The depth filter of one reference image: search along epipolar lines, Bayesian update.
 *
 * Inverse depth rho is along z of the reference camera, in 1 / map unit. A pixel's state is
 * (mu, sigma^2, a, b): Gaussian over rho times Beta over the share of good measurements
 * (Vogiatzis & Hernandez 2011; Pizzoli et al. 2014). Labels: 0 updating, 1 converged, 2 diverged,
 * 3 border or blank. Images are float, row-major, 0..255.
 */

#if !defined(RADIUS) || !defined(MAX_STEPS)
#error "RADIUS and MAX_STEPS must be defined"
#endif
#define SIDE (2 * RADIUS + 1)
#define AREA (SIDE * SIDE)

#if RADIUS == 2
#define MASK (float8)(1, 1, 1, 1, 1, 0, 0, 0)
#elif RADIUS == 3
#define MASK (float8)(1, 1, 1, 1, 1, 1, 1, 0)
#else
#error "RADIUS must be 2 or 3"
#endif

/* Sum of the lanes that a patch uses. */
static float lanes(float8 value)
{
    const float8 used = value * MASK;
    const float4 half_ = used.lo + used.hi;
    return half_.x + half_.y + half_.z + half_.w;
}

static float bilinear(__global const float *image, int width, float x, float y)
{
    const int ix = (int)x, iy = (int)y;
    const float fx = x - ix, fy = y - iy;
    __global const float *p = image + iy * width + ix;
    const float top = p[0] + fx * (p[1] - p[0]);
    const float bottom = p[width] + fx * (p[width + 1] - p[width]);
    return top + fy * (bottom - top);
}

/* Zero-mean normalised cross-correlation of a template (rows of SIDE values, zero mean, unit energy,
 * other lanes 0) with the patch around (x, y); -1 outside the image. A row is one vector: its lanes
 * share the fraction of a pixel, so that interpolation is two multiplications for all of them. */
static float correlate(__global const float *image, int width, int height, const float8 *template_,
                       float x, float y)
{
    const int ix = (int)x - RADIUS, iy = (int)y - RADIUS;
    /* a row is read 9 wide, and the last may not leave the buffer */
    if (!(x >= RADIUS && y >= RADIUS && ix + SIDE + 1 < width && iy + SIDE + 2 < height))
        return -1.0f;
    const float fx = x - (int)x, fy = y - (int)y;
    __global const float *p = image + iy * width + ix;
    float8 sum = 0.0f, square = 0.0f, cross = 0.0f;
    float8 left = vload8(0, p);
    float8 above = left + fx * (vload8(0, p + 1) - left);
#pragma unroll
    for (int j = 0; j < SIDE; ++j) {
        p += width;
        left = vload8(0, p);
        const float8 below = left + fx * (vload8(0, p + 1) - left);
        const float8 value = above + fy * (below - above);
        sum += value;
        square += value * value;
        cross += value * template_[j];
        above = below;
    }
    const float total = lanes(sum), energy = lanes(square) - total * total / AREA;
    return energy > 1.0f ? lanes(cross) * rsqrt(energy) : -1.0f;
}

/* One update of the pixels in `active`. Grid: one work-item for each of them, rounded up.
 *   reference, current  images, width x height
 *   active              (n_active) indices into the grid of pixels that are still worked on
 *   state, label        one for each grid pixel; grid pixel (x, y) is image pixel stride * (x, y)
 *   camera              fx, fy, cx, cy of both images
 *   m0, m1, m2          rows of current_from_reference: rotation in xyz, translation in w
 *   rho                 least and greatest inverse depth of the prior
 *   limits              least ZNCC; margin to a second peak; noise energy below which a template
 *                       is blank; floor of the position error in pixels
 *   accept              relative sigma of a converged pixel; its least inlier ratio; inlier ratio
 *                       of a diverged one
 */
__kernel void update(__global const float *reference, __global const float *current, const int width,
                     const int height, __global const int *active, const int n_active,
                     __global float4 *state, __global uchar *label, const int grid_width,
                     const int stride, const float4 camera, const float4 m0, const float4 m1,
                     const float4 m2, const float2 rho, const float4 limits, const float4 accept)
{
    const int item = get_global_id(0);
    if (item >= n_active)
        return;
    const int cell = active[item];
    const int u = (cell % grid_width) * stride, v = (cell / grid_width) * stride;

    float4 s = state[cell];
    const float reach = 2.5f * sqrt(s.y);
    const float rho_low = fmax(s.x - reach, rho.x), rho_high = fmin(s.x + reach, rho.y);
    const float3 ray = (float3)((u - camera.z) / camera.x, (v - camera.w) / camera.y, 1.0f);
    const float3 q0 = (float3)(dot(m0.xyz, ray), dot(m1.xyz, ray), dot(m2.xyz, ray));
    const float3 t = (float3)(m0.w, m1.w, m2.w);
    const float3 low = q0 + rho_low * t, high = q0 + rho_high * t, middle = q0 + s.x * t;
    if (low.z < 0.1f || high.z < 0.1f || middle.z < 0.1f)
        return;
    const float2 from = (float2)(camera.x * low.x / low.z + camera.z, camera.y * low.y / low.z + camera.w);
    const float2 to = (float2)(camera.x * high.x / high.z + camera.z, camera.y * high.y / high.z + camera.w);
    const float length_px = length(to - from);
    if (!(length_px > 0.02f))
        return;
    const float2 direction = (to - from) / length_px;

    /* the patch around this pixel as a plane that faces the reference at depth 1 / mu: how it lies in
     * the current image, and from there back, so that the template is warped once and not each patch */
    const float inverse_z = 1.0f / middle.z;
    const float2 at = middle.xy * inverse_z;
    const float3 dx = (float3)(m0.x, m1.x, m2.x) / camera.x, dy = (float3)(m0.y, m1.y, m2.y) / camera.y;
    const float2 ax = (float2)(camera.x * (dx.x - at.x * dx.z), camera.y * (dx.y - at.y * dx.z)) * inverse_z;
    const float2 ay = (float2)(camera.x * (dy.x - at.x * dy.z), camera.y * (dy.y - at.y * dy.z)) * inverse_z;
    const float determinant = ax.x * ay.y - ax.y * ay.x;
    if (!(determinant > 0.2f && determinant < 5.0f))
        return;
    const float2 bx = (float2)(ay.y, -ax.y) / determinant, by = (float2)(-ay.x, ax.x) / determinant;
    float8 template_[SIDE];
    float8 total = 0.0f;
    for (int j = 0; j < SIDE; ++j) {
        float row[8] = {0, 0, 0, 0, 0, 0, 0, 0};
        for (int i = 0; i < SIDE; ++i) {
            const float x = u + (i - RADIUS) * bx.x + (j - RADIUS) * by.x;
            const float y = v + (i - RADIUS) * bx.y + (j - RADIUS) * by.y;
            row[i] = bilinear(reference, width, clamp(x, 0.0f, width - 1.01f), clamp(y, 0.0f, height - 1.01f));
        }
        template_[j] = vload8(0, row);
        total += template_[j];
    }
    const float mean = lanes(total) / AREA;
    float8 squares = 0.0f;
    for (int j = 0; j < SIDE; ++j) {
        template_[j] = (template_[j] - mean) * MASK;
        squares += template_[j] * template_[j];
    }
    const float energy = lanes(squares);
    if (energy < limits.z) {
        label[cell] = 3; /* blank: no image will tell its depth */
        return;
    }
    const float scale = rsqrt(energy);
    for (int j = 0; j < SIDE; ++j)
        template_[j] *= scale;

    /* one pixel beyond both ends, so that a peak at an end has two sides */
    const int steps = max((int)ceil((length_px + 2.0f) / 1.0f), 4);
    if (steps > MAX_STEPS)
        return;
    const float step = (length_px + 2.0f) / steps;
    const float2 origin = from - direction;
    float best = -2.0f, second = -2.0f, before = -2.0f, after = -2.0f, previous = -2.0f;
    int best_at = -10;
    int seen = 0;
    for (int k = 0; k <= steps; ++k) {
        const float2 p = origin + direction * (k * step);
        const float value = correlate(current, width, height, template_, p.x, p.y);
        seen += value > -1.0f;
        if (k == best_at + 1)
            after = value;
        if (value > best) {
            if (k - best_at > 3)
                second = best;
            best = value;
            best_at = k;
            before = previous;
            after = -2.0f;
        } else if (k - best_at > 3 && value > second) {
            second = value;
        }
        previous = value;
    }
    if (seen < 3)
        return; /* out of view: says nothing */
    if (best < limits.x) {
        s.w += 0.5f;
        state[cell] = s;
        if (s.z / (s.z + s.w) < accept.z)
            label[cell] = 2;
        return;
    }
    if (second > best - limits.y || before <= -1.0f || after <= -1.0f)
        return; /* two places fit, or the peak is cut off */

    const float curvature = (before - 2.0f * best + after) / (step * step);
    if (curvature > -1e-4f)
        return;
    const float shift = clamp(0.5f * (before - after) / (before - 2.0f * best + after), -0.5f, 0.5f);
    const float2 p = origin + direction * ((best_at + shift) * step);
    /* variance of the peak from its curvature and what the correlation leaves unexplained */
    const float variance_px = 2.0f * (1.0f - fmin(best, 1.0f)) / (AREA * -curvature) + limits.w * limits.w;
    if (variance_px > 1.0f)
        return;

    const float2 n = (float2)((p.x - camera.z) / camera.x, (p.y - camera.w) / camera.y);
    const bool wide = fabs(direction.x) > fabs(direction.y);
    const float top = wide ? n.x * q0.z - q0.x : n.y * q0.z - q0.y;
    const float base = wide ? t.x - n.x * t.z : t.y - n.y * t.z;
    if (fabs(base) < 1e-9f)
        return;
    const float measured = top / base;
    const float3 q = q0 + measured * t;
    if (!(measured > 0.5f * rho.x && measured < 1.5f * rho.y && q.z > 0.1f))
        return;
    const float2 slope = (float2)(camera.x * (t.x * q.z - q.x * t.z), camera.y * (t.y * q.z - q.y * t.z)) / (q.z * q.z);
    const float tau2 = variance_px / fmax(dot(slope, slope), 1e-20f);

    const float sum2 = s.y + tau2;
    const float fused2 = s.y * tau2 / sum2;
    const float fused = fused2 * (s.x / s.y + measured / tau2);
    const float miss = measured - s.x;
    float c1 = s.z / (s.z + s.w) * exp(-0.5f * miss * miss / sum2) * rsqrt(6.2831853f * sum2);
    float c2 = s.w / (s.z + s.w) / (rho.y - rho.x);
    const float norm = c1 + c2;
    if (!(norm > 0.0f))
        return;
    c1 /= norm;
    c2 /= norm;
    const float ab = s.z + s.w;
    const float f = c1 * (s.z + 1.0f) / (ab + 1.0f) + c2 * s.z / (ab + 1.0f);
    const float e = (c1 * (s.z + 1.0f) * (s.z + 2.0f) + c2 * s.z * (s.z + 1.0f)) / ((ab + 1.0f) * (ab + 2.0f));
    const float mu = c1 * fused + c2 * s.x;
    const float sigma2 = c1 * (fused2 + fused * fused) + c2 * (s.y + s.x * s.x) - mu * mu;
    const float a = (e - f) / (f - e / f);
    const float b = a * (1.0f - f) / f;
    if (!(sigma2 > 0.0f && mu > 0.0f && isfinite(a) && isfinite(b)))
        return;
    state[cell] = (float4)(mu, sigma2, a, b);
    const float ratio = a / (a + b);
    if (ratio < accept.z)
        label[cell] = 2;
    else if (ratio > accept.y && sigma2 < accept.x * accept.x * mu * mu)
        label[cell] = 1;
}

/* Regulariser, dual step: p <- project(p + step * weight * grad(x_bar)), Huber's smoothing h.
 * Grid: width x height of the pixel grid. `edge` (0..1) is small across image edges. */
__kernel void dual(__global const float *x_bar, __global const float *edge, __global float2 *p,
                   const int width, const int height, const float step, const float huber)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height)
        return;
    const int i = y * width + x;
    const float here = x_bar[i];
    const float2 gradient = (float2)(x + 1 < width ? x_bar[i + 1] - here : 0.0f,
                                     y + 1 < height ? x_bar[i + width] - here : 0.0f);
    const float2 moved = (p[i] + step * edge[i] * gradient) / (1.0f + step * huber);
    p[i] = moved / fmax(1.0f, length(moved));
}

/* Regulariser, primal step: x <- (x + step * (div(edge p) + weight * data)) / (1 + step * weight).
 * `weight` is 0 where there is no measurement. Dual and primal are launched apart: no race. */
__kernel void primal(__global float *x_now, __global float *x_bar, __global const float *edge,
                     __global const float2 *p, __global const float *data, __global const float *weight,
                     const int width, const int height, const float step)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height)
        return;
    const int i = y * width + x;
    float divergence = (x + 1 < width ? edge[i] * p[i].x : 0.0f) + (y + 1 < height ? edge[i] * p[i].y : 0.0f);
    if (x > 0)
        divergence -= edge[i - 1] * p[i - 1].x;
    if (y > 0)
        divergence -= edge[i - width] * p[i - width].y;
    const float old = x_now[i];
    const float now = (old + step * (divergence + weight[i] * data[i])) / (1.0f + step * weight[i]);
    x_now[i] = now;
    x_bar[i] = 2.0f * now - old;
}
