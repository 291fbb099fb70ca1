"""Depth map as a colour image: near is red, far is blue, invalid is black."""

from __future__ import annotations

import cv2
import numpy as np

from companion.messages import Bytes, DepthMap
from companion.streaming.items import DepthItem

PNG = "image/png"


def depth_picture(depth_map: DepthMap) -> DepthItem | None:
    """Colour image of a depth map as PNG; None where no pixel is valid."""
    rgb = depth_colours(depth_map)
    if rgb is None:
        return None
    _, png = cv2.imencode(".png", rgb[..., ::-1])
    return DepthItem(depth_map.t_ns, png.tobytes(), PNG, dict(depth_map.kernel_ms))


def depth_colours(depth_map: DepthMap) -> Bytes | None:
    """Colour image (H, W, 3), RGB, of a depth map; None where no pixel is valid."""
    depth = depth_map.depth
    known = depth > 0
    if not known.any():
        return None
    inverse = 1.0 / np.where(known, depth, 1.0)
    low, high = np.quantile(inverse[known], [0.02, 0.98])
    level = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1) * 255
    colour = cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_TURBO)
    colour[~known] = 0
    return np.asarray(colour[..., ::-1], np.uint8)
