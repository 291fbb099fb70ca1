/* Huber total variation of inverse depth, by first-order primal-dual steps (Chambolle & Pock 2011).
 *
 * Rows of a buffer are `pitch` numbers long, a multiple of 8, of which the first `width` are pixels;
 * a row of zeros lies above the first and one below the last. `edge` (0..1) is small across image
 * edges and 0 beyond the grid, where the dual variables therefore stay 0: no step has to ask where the
 * grid ends, but for the neighbour at the right of a row's last pixel and the one below the last row.
 * A work-item does 8 pixels of a row: one kernel's grid is pitch / 8 x height. */

typedef float8 float8_anywhere __attribute__((aligned(4)));

#define AT(buffer, i) (*(__global const float8_anywhere *)((buffer) + (i)))

/* Dual step: p <- project(p + step * edge * grad(x_bar)), Huber's smoothing h. */
__kernel void dual(__global const float *x_bar, __global const float *edge, __global float *px,
                   __global float *py, const int width, const int height, const int pitch, const float step,
                   const float shrink)
{
    const int x = 8 * get_global_id(0), y = get_global_id(1);
    if (x >= pitch || y >= height)
        return;
    const int i = (y + 1) * pitch + x;
    const float8 here = AT(x_bar, i), along = step * AT(edge, i);
    const int8 lane = (int8)(1, 2, 3, 4, 5, 6, 7, 8) + x;
    const float8 right = lane < width ? AT(x_bar, i + 1) - here : 0.0f;
    const float8 below = (float)(y + 1 < height) * (AT(x_bar, i + pitch) - here);
    const float8 to_x = (AT(px, i) + along * right) * shrink, to_y = (AT(py, i) + along * below) * shrink;
    const float8 square = to_x * to_x + to_y * to_y;
    const float8 scale = 1.0f / sqrt(square > 1.0f ? square : 1.0f);
    *(__global float8 *)(px + i) = to_x * scale;
    *(__global float8 *)(py + i) = to_y * scale;
}

/* Primal step: x <- (x + step * (div(edge p) + weight * data)) / (1 + step * weight).
 * `share` is 1 / (1 + step * weight), `pull` is step * weight * data; both as if the weight were 0 where
 * there is no measurement. Dual and primal are separate launches: no race. */
__kernel void primal(__global float *x_now, __global float *x_bar, __global const float *edge,
                     __global const float *px, __global const float *py, __global const float *pull,
                     __global const float *share, const int height, const int pitch, const float step)
{
    const int x = 8 * get_global_id(0), y = get_global_id(1);
    if (x >= pitch || y >= height)
        return;
    const int i = (y + 1) * pitch + x;
    const float8 out = AT(edge, i) * (AT(px, i) + AT(py, i));
    const float8 in = AT(edge, i - 1) * AT(px, i - 1) + AT(edge, i - pitch) * AT(py, i - pitch);
    const float8 old = AT(x_now, i);
    const float8 now = (old + step * (out - in) + AT(pull, i)) * AT(share, i);
    *(__global float8 *)(x_now + i) = now;
    *(__global float8 *)(x_bar + i) = 2.0f * now - old;
}
