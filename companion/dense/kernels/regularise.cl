/* Huber total variation of inverse depth, by first-order primal-dual steps (Chambolle & Pock 2011). */

/* Dual step: p <- project(p + step * weight * grad(x_bar)), Huber's smoothing h.
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

/* Primal step: x <- (x + step * (div(edge p) + weight * data)) / (1 + step * weight).
 * `weight` is 0 where there is no measurement. Dual and primal are separate launches: no race. */
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
