"""Features extracted ahead: the same as without, and none where they would not be."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import FeaturesConfig
from companion.messages import Bytes
from companion.slam.features.faint_pictures import strengthened
from companion.slam.features.features_ahead import FeaturesAhead
from companion.slam.features.orb_features import FeatureExtractor, Features
from tests.unit.slam.test_orb_features import LENS, textured

CONFIG = FeaturesConfig(n_features=400)


@pytest.fixture
def images() -> list[Bytes]:
    """Of less and less contrast, so that the threshold goes on falling."""
    grey = textured(640, 480).astype(np.float32)
    return [(128 + (grey - 128) / fade).astype(np.uint8) for fade in (1, 5, 12, 20, 20)]


def same(a: Features, b: Features) -> None:
    np.testing.assert_array_equal(a.pixels, b.pixels)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)


def test_features_and_thresholds_are_those_of_one_after_the_other(images: list[Bytes]) -> None:
    direct, extractor = FeatureExtractor(CONFIG, LENS), FeatureExtractor(CONFIG, LENS)
    ahead = FeaturesAhead(CONFIG, LENS, extractor)
    for grey in images:
        ahead.begin(grey)
    states = set()
    for grey in images:
        found = ahead.take(grey)
        assert found is not None
        same(found, direct.extract(strengthened(grey).corners))
        assert extractor.state == direct.state
        states.add(direct.state)
    assert len(states) > 1
    assert ahead.take(images[0]) is None
    ahead.close()


def test_another_image_ends_it(images: list[Bytes]) -> None:
    extractor = FeatureExtractor(CONFIG, LENS)
    ahead = FeaturesAhead(CONFIG, LENS, extractor)
    before = extractor.state
    for grey in images[2:]:
        ahead.begin(grey)
    assert ahead.take(images[2].copy()) is None
    assert extractor.state == before
    ahead.begin(images[0])
    assert ahead.take(images[0]) is None


def test_fewer_features_under_load_are_not_those_begun(images: list[Bytes]) -> None:
    extractor = FeatureExtractor(CONFIG, LENS)
    ahead = FeaturesAhead(CONFIG, LENS, extractor)
    ahead.begin(images[0])
    extractor.feature_ratio = 0.5
    assert ahead.take(images[0]) is None
