/* REMODE's depth filter (Pizzoli, Forster, Scaramuzza, ICRA 2014) for one core: the serial reference
 * that `python -m tests.bench.accuracy depth` times the engine against. Written from the algorithm's description.
 *
 * Depth is euclidean, along a pixel's unit ray. Images are float, row-major, 0..1. Poses are 3x4,
 * row-major. States: 0 update, 1 converged, 2 border, 3 diverged, 4 no match, 5 not seen.
 */

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { HALF = 2, SIDE = 5, AREA = 25, BORDER = 5 };
enum { UPDATE, CONVERGED, BORDER_PIXEL, DIVERGED, NO_MATCH, NOT_VISIBLE };

static const float LEAST_NCC = 0.5f, STEP_PX = 0.7f, LONGEST_PX = 100.0f;
static const float ENOUGH_INLIERS = 0.7f, TOO_FEW_INLIERS = 0.05f;

typedef struct {
    int width, height;
    float fx, fy, cx, cy;
    float range;
    float *reference, *sum_t, *var_t;
    float *mu, *sigma2, *a, *b;
    float *match_x, *match_y;
    unsigned char *state;
} Filter;

typedef struct { float x, y, z; } Vec;

static Vec vec(float x, float y, float z) { Vec v = {x, y, z}; return v; }
static float dot(Vec p, Vec q) { return p.x * q.x + p.y * q.y + p.z * q.z; }
static float norm(Vec p) { return sqrtf(dot(p, p)); }
static Vec scaled(Vec p, float s) { return vec(p.x * s, p.y * s, p.z * s); }
static Vec minus(Vec p, Vec q) { return vec(p.x - q.x, p.y - q.y, p.z - q.z); }

static Vec turned(const float *m, Vec p)
{
    return vec(m[0] * p.x + m[1] * p.y + m[2] * p.z, m[4] * p.x + m[5] * p.y + m[6] * p.z,
               m[8] * p.x + m[9] * p.y + m[10] * p.z);
}

static Vec moved(const float *m, Vec p)
{
    const Vec q = turned(m, p);
    return vec(q.x + m[3], q.y + m[7], q.z + m[11]);
}

static Vec unit_ray(const Filter *f, float x, float y)
{
    const Vec ray = vec((x - f->cx) / f->fx, (y - f->cy) / f->fy, 1.0f);
    return scaled(ray, 1.0f / norm(ray));
}

static float sample(const float *image, int width, float x, float y)
{
    const int ix = (int)x, iy = (int)y;
    const float ax = x - ix, ay = y - iy;
    const float *p = image + iy * width + ix;
    return (1 - ay) * ((1 - ax) * p[0] + ax * p[1]) + ay * ((1 - ax) * p[width] + ax * p[width + 1]);
}

void remode_free(Filter *f)
{
    if (!f)
        return;
    float *all[] = {f->reference, f->sum_t, f->var_t, f->mu, f->sigma2, f->a, f->b, f->match_x, f->match_y};
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        free(all[i]);
    free(f->state);
    free(f);
}

Filter *remode_begin(const float *image, int width, int height, const float *camera, float nearest,
                     float farthest)
{
    Filter *f = calloc(1, sizeof *f);
    if (!f)
        return NULL;
    const size_t n = (size_t)width * height;
    f->width = width, f->height = height;
    f->fx = camera[0], f->fy = camera[1], f->cx = camera[2], f->cy = camera[3];
    f->range = farthest - nearest;
    float **all[] = {&f->reference, &f->sum_t, &f->var_t, &f->mu, &f->sigma2, &f->a, &f->b, &f->match_x, &f->match_y};
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        if (!(*all[i] = calloc(n, sizeof(float)))) {
            remode_free(f);
            return NULL;
        }
    if (!(f->state = calloc(n, 1))) {
        remode_free(f);
        return NULL;
    }
    memcpy(f->reference, image, n * sizeof(float));
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            const size_t i = (size_t)y * width + x;
            f->mu[i] = 0.5f * (nearest + farthest);
            f->sigma2[i] = f->range * f->range / 36.0f;
            f->a[i] = f->b[i] = 10.0f;
            if (x < BORDER || y < BORDER || x >= width - BORDER || y >= height - BORDER)
                continue;
            float sum = 0, squares = 0;
            for (int j = -HALF; j <= HALF; ++j)
                for (int k = -HALF; k <= HALF; ++k) {
                    const float t = image[(y + j) * width + x + k];
                    sum += t;
                    squares += t * t;
                }
            f->sum_t[i] = sum;
            f->var_t[i] = AREA * squares - sum * sum;
        }
    return f;
}

static void check(Filter *f)
{
    for (int y = 0; y < f->height; ++y)
        for (int x = 0; x < f->width; ++x) {
            const size_t i = (size_t)y * f->width + x;
            const float a = f->a[i], b = f->b[i];
            if (x < BORDER || y < BORDER || x >= f->width - BORDER || y >= f->height - BORDER)
                f->state[i] = BORDER_PIXEL;
            else if (a / (a + b) > ENOUGH_INLIERS && f->sigma2[i] < f->range / 1000.0f)
                f->state[i] = CONVERGED;
            else if ((a - 1) / (a + b - 2) < TOO_FEW_INLIERS)
                f->state[i] = DIVERGED;
            else
                f->state[i] = UPDATE;
        }
}

/* Zero-mean NCC of the patches around a reference pixel and a place in the current image. */
static float correlation(const Filter *f, const float *current, int x, int y, float px, float py)
{
    float sum = 0, squares = 0, cross = 0;
    for (int j = -HALF; j <= HALF; ++j)
        for (int k = -HALF; k <= HALF; ++k) {
            const float t = f->reference[(y + j) * f->width + x + k];
            const float c = sample(current, f->width, px + k, py + j);
            sum += c;
            squares += c * c;
            cross += c * t;
        }
    const size_t i = (size_t)y * f->width + x;
    const float top = AREA * cross - sum * f->sum_t[i];
    const float bottom = (AREA * squares - sum * sum) * f->var_t[i];
    return bottom > 1e-12f ? top / sqrtf(bottom) : -1.0f;
}

static void search(Filter *f, const float *current, const float *pose, int x, int y)
{
    const size_t i = (size_t)y * f->width + x;
    const Vec ray = unit_ray(f, x, y);
    const float sigma = sqrtf(f->sigma2[i]);
    const Vec low = moved(pose, scaled(ray, fmaxf(f->mu[i] - 3 * sigma, 0.01f)));
    const Vec high = moved(pose, scaled(ray, f->mu[i] + 3 * sigma));
    const Vec middle = moved(pose, scaled(ray, f->mu[i]));
    f->state[i] = NOT_VISIBLE;
    if (middle.z <= 0 || low.z <= 0 || high.z <= 0)
        return;
    const float x0 = f->fx * low.x / low.z + f->cx, y0 = f->fy * low.y / low.z + f->cy;
    const float x1 = f->fx * high.x / high.z + f->cx, y1 = f->fy * high.y / high.z + f->cy;
    const float mx = f->fx * middle.x / middle.z + f->cx, my = f->fy * middle.y / middle.z + f->cy;
    float dx = x1 - x0, dy = y1 - y0;
    const float length = sqrtf(dx * dx + dy * dy);
    if (length > 0)
        dx /= length, dy /= length;
    const float half = 0.5f * fminf(length, LONGEST_PX);
    float best = -1;
    int seen = 0;
    for (float l = -half; l <= half; l += STEP_PX) {
        const float px = mx + l * dx, py = my + l * dy;
        if (!(px >= BORDER && py >= BORDER && px < f->width - BORDER && py < f->height - BORDER))
            continue;
        seen = 1;
        const float score = correlation(f, current, x, y, px, py);
        if (score > best) {
            best = score;
            f->match_x[i] = px, f->match_y[i] = py;
        }
    }
    if (seen)
        f->state[i] = best < LEAST_NCC ? NO_MATCH : UPDATE;
}

static void match(Filter *f, const float *current, const float *pose)
{
    for (int y = 0; y < f->height; ++y)
        for (int x = 0; x < f->width; ++x)
            if (f->state[(size_t)y * f->width + x] == UPDATE)
                search(f, current, pose, x, y);
}

/* Distance along a unit ray to the middle of the shortest line to another; below 0: none. */
static float triangulated(const float *back, Vec ray, Vec other)
{
    const Vec t = vec(back[3], back[7], back[11]), g = turned(back, other);
    const float a = dot(ray, ray), b = dot(ray, g), c = dot(g, g), d = dot(t, ray), e = dot(t, g);
    const float determinant = b * b - a * c;
    if (fabsf(determinant) < 1e-12f)
        return -1;
    const float along = (b * e - c * d) / determinant, across = (a * e - b * d) / determinant;
    const Vec p = scaled(ray, along), q = vec(t.x + across * g.x, t.y + across * g.y, t.z + across * g.z);
    return norm(scaled(vec(p.x + q.x, p.y + q.y, p.z + q.z), 0.5f)) * (along > 0 ? 1.0f : -1.0f);
}

static void fuse(Filter *f, const float *back, float one_pixel, int x, int y)
{
    const size_t i = (size_t)y * f->width + x;
    const Vec ray = unit_ray(f, x, y);
    const float d = triangulated(back, ray, unit_ray(f, f->match_x[i], f->match_y[i]));
    if (!(d > 0))
        return;
    const Vec t = vec(back[3], back[7], back[11]), across = minus(scaled(ray, d), t);
    const float base = norm(t), reach = norm(across);
    const float alpha = acosf(dot(ray, t) / base);
    const float beta = acosf(-dot(across, t) / (reach * base)) + one_pixel;
    const float tau = base * sinf(beta) / sinf((float)M_PI - alpha - beta) - d;
    const float tau2 = tau * tau;
    const float mu = f->mu[i], sigma2 = f->sigma2[i], a = f->a[i], b = f->b[i];
    const float s2 = tau2 * sigma2 / (tau2 + sigma2), m = s2 * (mu / sigma2 + d / tau2);
    const float spread = sigma2 + tau2, miss = d - mu;
    float c1 = a / (a + b) * expf(-miss * miss / (2 * spread)) / sqrtf(2 * (float)M_PI * spread);
    float c2 = b / (a + b) / f->range;
    const float sum = c1 + c2;
    c1 /= sum, c2 /= sum;
    const float ab = a + b;
    const float first = c1 * (a + 1) / (ab + 1) + c2 * a / (ab + 1);
    const float second = (c1 * (a + 1) * (a + 2) + c2 * a * (a + 1)) / ((ab + 1) * (ab + 2));
    const float mean = c1 * m + c2 * mu;
    const float variance = c1 * (s2 + m * m) + c2 * (sigma2 + mu * mu) - mean * mean;
    const float new_a = (second - first) / (first - second / first);
    const float new_b = new_a * (1 - first) / first;
    if (!(isfinite(mean) && isfinite(variance) && variance > 0 && isfinite(new_a) && isfinite(new_b)))
        return;
    f->mu[i] = mean, f->sigma2[i] = variance, f->a[i] = new_a, f->b[i] = new_b;
}

/* `pose`: current from reference; `back`: the other way round. */
void remode_update(Filter *f, const float *current, const float *pose, const float *back)
{
    check(f);
    match(f, current, pose);
    const float one_pixel = 2.0f * atanf(1.0f / (2.0f * f->fx));
    for (int y = 0; y < f->height; ++y)
        for (int x = 0; x < f->width; ++x) {
            const size_t i = (size_t)y * f->width + x;
            if (f->state[i] == UPDATE)
                fuse(f, back, one_pixel, x, y);
            else if (f->state[i] == NO_MATCH || f->state[i] == NOT_VISIBLE)
                f->b[i] += 1;
        }
}

/* Distances and states as they stand. */
void remode_state(Filter *f, float *distance, unsigned char *state)
{
    const size_t n = (size_t)f->width * f->height;
    check(f);
    memcpy(distance, f->mu, n * sizeof(float));
    memcpy(state, f->state, n);
}

/* Distances after TV-L1 denoising. 0: no memory. */
int remode_denoise(const Filter *f, float *smooth)
{
    const int w = f->width, h = f->height;
    const size_t n = (size_t)w * h;
    const float lambda = 0.5f, tau = 0.02f, sigma = 1.0f / (8.0f * tau), theta = 0.5f;
    const float large = f->range * f->range / 72.0f;
    float *u = malloc(n * sizeof *u), *head = malloc(n * sizeof *head), *g = malloc(n * sizeof *g);
    float *px = calloc(n, sizeof *px), *py = calloc(n, sizeof *py);
    const int enough = u && head && g && px && py;
    for (size_t i = 0; enough && i < n; ++i) {
        const float e = f->a[i] / (f->a[i] + f->b[i]);
        g[i] = fmaxf((e * f->sigma2[i] + (1 - e) * large) / large, 1.0f);
        u[i] = head[i] = f->mu[i];
    }
    for (int iteration = 0; enough && iteration < 200; ++iteration) {
        for (int y = 0; y < h; ++y)
            for (int x = 0; x < w; ++x) {
                const size_t i = (size_t)y * w + x;
                const float gx = x + 1 < w ? head[i + 1] - head[i] : 0;
                const float gy = y + 1 < h ? head[i + w] - head[i] : 0;
                const float qx = px[i] + sigma * g[i] * gx, qy = py[i] + sigma * g[i] * gy;
                const float scale = fmaxf(1.0f, sqrtf(qx * qx + qy * qy));
                px[i] = qx / scale, py[i] = qy / scale;
            }
        for (int y = 0; y < h; ++y)
            for (int x = 0; x < w; ++x) {
                const size_t i = (size_t)y * w + x;
                const float div = g[i] * px[i] - (x > 0 ? g[i - 1] * px[i - 1] : 0) + g[i] * py[i]
                                  - (y > 0 ? g[i - w] * py[i - w] : 0);
                const float old = u[i], now = old + tau * div, data = f->mu[i];
                const float miss = now - data, limit = tau * lambda;
                u[i] = miss > limit ? now - limit : miss < -limit ? now + limit : data;
                head[i] = u[i] + theta * (u[i] - old);
            }
    }
    if (enough)
        memcpy(smooth, u, n * sizeof(float));
    free(u), free(head), free(g), free(px), free(py);
    return enough;
}
