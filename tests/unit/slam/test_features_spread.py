"""Even distribution of selected corners over an image."""

from __future__ import annotations

import numpy as np
import pytest

from companion.slam.compiled.spreading import spread
from tests.support.reference import numpy_kernels


@pytest.mark.parametrize("n_wanted", [0, 1, 7, 300, 999])
@pytest.mark.parametrize("cell_px", [8, 32, 512])
def test_selected_corners_match_numpy(n_wanted: int, cell_px: int) -> None:
    rng = np.random.default_rng(cell_px)
    pixels = (rng.beta(1.0, 4.0, (1000, 2)) * [639, 479]).astype(np.float32)
    response = rng.integers(0, 50, 1000).astype(np.float32)  # many are equally strong
    kept = spread(pixels, response, cell_px, n_wanted)
    np.testing.assert_array_equal(kept, numpy_kernels.spread(pixels, response, cell_px, n_wanted))
    assert len(kept) == n_wanted


def test_few_corners_are_all_selected() -> None:
    pixels, response = np.zeros((5, 2), np.float32), np.arange(5, dtype=np.float32)
    assert spread(pixels, response, 32, 5).tolist() == [0, 1, 2, 3, 4]
    assert spread(pixels[:0], response[:0], 32, 5).tolist() == []
    assert spread(pixels, response, 32, 2).tolist() == [3, 4]
