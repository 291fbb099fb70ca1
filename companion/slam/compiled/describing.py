"""Description kernel: directions and binary descriptors of corners (Rublee et al., ICCV 2011)."""

from __future__ import annotations

from base64 import b85decode

import numpy as np
from numpy.typing import NDArray

from companion.messages import Bytes, Floats
from companion.slam.compiled.compiling import (
    Ints,
    compiled,
    given,
    integers,
    part,
    tables,
    tiny_word,
)

# positive for the compiler only where they are unsigned; then it reads runs of pixels at once
_1, _2, _3, _4, _5, _6 = (np.uintp(k) for k in range(1, 7))
_ROWS = 8
"""Blurred as one, with their ends."""
_REACH = 15
"""Radius in pixels of the disc whose centroid is a corner's direction."""
_BLUR = np.exp(-(np.arange(4.0) ** 2) / 8.0)
_W0, _W1, _W2, _W3 = (_BLUR / (2.0 * _BLUR.sum() - 1.0)).astype(np.float32)
"""Weights of a Gaussian of two pixels, by distance."""
_PATTERN = np.frombuffer(b85decode(
    b"2>l5K1Of;2^$GX_2lNc{0`me40r>$2{`UU-^Yiui^ZoSq3Iq!Y^Z5Ap^#}J12L}uW{QLa?^8)n!_W=0?4EhZJ{RaLF`t"
    b"$tw3-b*41P28H1^o*B1NjCF`1$(&{tN&1^9=Y3`2+j?`~v+4_VoG-1@s2_1^Ng70RRO12@4DJ1P25R0{;XA{Pg|@`1|?"
    b"x1Pcia0Qdp(^Zxh({r>&~`U(8^2n-4b00{vD2m1^5^ZNAw3I_}U`u+M03ik~B^9cC#^8on#0|N&L1qTZG{|5o|1NH?50"
    b"{jE^^8oV&^ZE1)^8@t=`3(FA2KEdH_y76&{`&w7^ac3^1NI2>`T6_>{r>;?0tp56_4E7l{{{g61^opA{PX+__xkq+^!E"
    b"7t3IYuM2Mi1h`Sbb({0aR82mcHL`3Cy|^9%F^{RjT~2lx#6^ZE7k0sRaN0{R00`~&{;|MLL}2LTBB0sjLG2>}cS|M&j`"
    b"^Yiuv2L}oa4EqcT1_K8R1@i_90`vj{0|*5A0tO883G@mB_yqY0^$h&_0Sp582KNX20s{m71_KKK1N{j22M7rR_51q#_6"
    b"z$8`}q9~_67F<2>%TF1o{T`_6+z31pWpG{s8_A`}q3;2l@&O_w)Gp`}6z$2>1!}_x1Mx0r&y_2mA>E{sI5|3;GQ8^!NG"
    b"%0|y5T1qBKS0Q>?7_YC{<00#mL{{jIA1q%oF0|f^7^ZfV;`w9L1{Q3R#1_cNJ`3Cw7^9K9=0rmq51OW*A{{8~<0`v?F{"
    b"__C(1OW*H`u6?%{qz3;2L%lE1pWp2^9lF+2LT8M2lxjD`TY3-_zU^?^9J<z0t5pI3i}KL`uq9^2>l880`vk1_5St)^z-"
    b"@m^#Jz!1^o*M{`3C~|M&n2^Y!%m_Wt$@{R#f_0{sI5_w)P!{09B@{0#p2`t|$?2K@#L^9%b03kwVe2m1{E{|o>J{P_L;"
    b"`2qR|^Yr-h`TqL&_yzj+`~Um}^9T3}0R;u~0RRf~2@DGV1^5d0{|f>0_x<_;|Mme4^8xtw2=xm30`mj<2lEW~_V)Yv_W"
    b"1bo1o{XC0}KfB`~v;`1@j8@1oH*|_X+$100RT}^a1(-0|Es2_V)G(2=fdK`1Jbw0s;dE3I+@K1_%iB`3m|4{rCL||MUL"
    b"^{rUX_`2P3<1Of~U0{a6C2KNi|1OEpM3;zrR{Q&(21oZ?A0{j92_WJk%^9S_-^9=R#1^^550RI65^8@$(_Xzs^^ZNMy1"
    b"@{OF0tW;4|N8&`2?Y!O3;hiE0{{aB{{#RE1NsC7^8oe*1qcia2nh-L2mA>1_5}6`2LlWQ3Hb{C2LKHI|M~#+"
), np.int8).reshape(512, 2).astype(np.float32)  # fmt: skip
"""Pixels (x, y) that are compared, two for each bit: as OpenCV, so that maps kept fit."""
_X, _Y = _PATTERN.T.copy()
_ROUND = np.float32(12582912.0)
"""Added and taken away it leaves the nearest integer: three halves of the 24 bits of a number."""
_DEGREE = np.float32(np.pi / 180.0)
_ATAN = np.float32(180.0 / np.pi) * np.array(
    [-0.04432655554792128, 0.1555786518463281, -0.3258083974640975, 0.9997878412794807], np.float32
)


def _disc() -> Ints:
    """Ones within a disc (16, 32): rows from its middle down, columns from its left edge."""
    half = round(_REACH / np.sqrt(2.0))
    wide = [round(np.sqrt(_REACH**2 - v**2)) for v in range(half + 1)]
    # the rest mirrored about the diagonal, so that turning the image by 90 degrees turns it too
    wide += [sum(w >= v for w in wide) - 1 for v in range(half + 1, _REACH + 1)]
    return (np.abs(np.arange(-_REACH, _REACH + 2)) <= np.array(wide)[:, None]).astype(np.int16)


_DISC = _disc()
_ACROSS = (_DISC * np.arange(-_REACH, _REACH + 2)).astype(np.int16)


@part
def _direction(image: Bytes, width: int, at: int) -> np.float32:
    """Angle in degrees of the centroid of the disc about a pixel."""
    along, down = 0, 0
    for v in range(_REACH + 1):
        below = image[at + v * width - _REACH : at + v * width + _REACH + 2]
        above = image[at - v * width - _REACH : at - v * width + _REACH + 2]
        of_row_along, of_row_down = np.int32(0), np.int32(0)
        for k in range(32):
            one, other = np.int32(below[k]), np.int32(above[k] if v > 0 else 0)
            of_row_along = np.int32(of_row_along + _ACROSS[v, k] * (one + other))
            of_row_down = np.int32(of_row_down + _DISC[v, k] * (one - other))
        along, down = along + int(of_row_along), down + v * int(of_row_down)
    x, y = np.float32(along), np.float32(down)
    near, far = min(abs(x), abs(y)), max(abs(x), abs(y))
    ratio = near / (far + np.float32(2.220446e-16))
    r2 = ratio * ratio
    angle = (((_ATAN[0] * r2 + _ATAN[1]) * r2 + _ATAN[2]) * r2 + _ATAN[3]) * ratio
    if abs(y) > abs(x):
        angle = np.float32(90.0) - angle
    if x < 0.0:
        angle = np.float32(180.0) - angle
    return np.float32(np.float32(360.0) - angle if y < 0.0 else angle)


@part
def _blur_down(
    up3: Bytes, up2: Bytes, up1: Bytes, row: Bytes, down1: Bytes, down2: Bytes, down3: Bytes,
    n: int, out: Floats,
) -> None:  # fmt: skip
    """Blur `n` pixels of a row downwards."""
    for x in range(n):
        out[x] = (
            _W0 * np.float32(row[x]) + _W1 * np.float32(np.int32(up1[x] + down1[x]))
            + _W2 * np.float32(np.int32(up2[x] + down2[x]))
            + _W3 * np.float32(np.int32(up3[x] + down3[x]))
        )  # fmt: skip


@part
def _blur_along(row: Floats, n: int, out: Bytes) -> None:
    """Blur `n` pixels of a row, which begins three before, along it."""
    for i in range(n):
        x = np.uintp(i)
        blurred = (
            _W0 * row[x + _3] + _W1 * (row[x + _2] + row[x + _4])
            + _W2 * (row[x + _1] + row[x + _5]) + _W3 * (row[x] + row[x + _6])
        )  # fmt: skip
        out[x] = np.uint8(np.int32((blurred + _ROUND) - _ROUND))


@part
def _compared(
    cosine: np.float32, sine: np.float32, width: np.float32, out: NDArray[np.int32]
) -> None:
    """Offsets (512,) of the pattern's pixels, turned, in an image of this width."""
    for k in range(len(out)):
        x = ((_X[k] * cosine - _Y[k] * sine) + _ROUND) - _ROUND
        y = ((_X[k] * sine + _Y[k] * cosine) + _ROUND) - _ROUND
        out[k] = np.int32(y * width + x)


@compiled(given(tiny_word, 1), tables, integers, integers)
def described(pyramid: Bytes, levels: Ints, level: Ints, at: Ints) -> tuple[Floats, Bytes]:
    """Angles (N,) in degrees and descriptors (N, 32) of corners, in order of their levels.

    `pyramid`, `levels` (L, 4), `level` (N,) and the places `at` (N,) as of `corners`.
    """
    angles, out = np.empty(len(at), np.float32), np.empty((len(at), 32), np.uint8)
    offsets, n = np.empty(512, np.int32), 0
    blurred = np.empty(levels[0, 1] * levels[0, 2], np.uint8)
    rows = np.empty(_ROWS * levels[0, 1], np.float32)
    for i in range(len(levels)):
        start, width, height = levels[i, 0], levels[i, 1], levels[i, 2]
        if n == len(at) or level[n] != i:
            continue
        for y in range(3, height - 3, _ROWS):
            first, n_blurred = start + y * width, min(_ROWS, height - 3 - y) * width
            _blur_down(
                pyramid[first - 3 * width :], pyramid[first - 2 * width :],
                pyramid[first - width :], pyramid[first:], pyramid[first + width :],
                pyramid[first + 2 * width :], pyramid[first + 3 * width :], n_blurred, rows,
            )  # fmt: skip
            _blur_along(rows, n_blurred - 6, blurred[y * width + 3 :])
        while n < len(at) and level[n] == i:
            angles[n] = _direction(pyramid, width, at[n])
            turn = angles[n] * _DEGREE
            _compared(np.cos(turn), np.sin(turn), np.float32(width), offsets)
            here = np.uintp(at[n] - start)
            for byte in range(32):
                bits = 0
                for k in range(8):
                    one, other = offsets[16 * byte + 2 * k], offsets[16 * byte + 2 * k + 1]
                    bits |= (
                        int(blurred[here + np.uintp(one)] < blurred[here + np.uintp(other)]) << k
                    )
                out[n, byte] = bits
            n += 1
    return angles, out
