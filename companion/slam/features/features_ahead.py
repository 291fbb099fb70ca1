"""Features of images that are still to come, extracted beside the work on those before them."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor

from companion.config import FeaturesConfig
from companion.geometry.camera import Camera
from companion.messages import Bytes
from companion.slam.features.faint_pictures import strengthened
from companion.slam.features.orb_features import FeatureExtractor, Features


class FeaturesAhead:
    """Extracts in a thread of its own, in order, what an extractor is about to be asked for.

    Its results are used only where the extractor would have given the same: for the same image,
    from the same state. From the first image that is another (of a rolling shutter, or features
    left out under load) nothing is extracted ahead any more.
    """

    def __init__(self, config: FeaturesConfig, camera: Camera, extractor: FeatureExtractor) -> None:
        self._extractor = extractor
        self._own = FeatureExtractor(config, camera)
        self._own.state = extractor.state
        self._begun: deque[tuple[Bytes, Future[_Extracted]]] = deque()
        self._thread = ThreadPoolExecutor(1, "features")
        self._is_open = True

    def begin(self, grey: Bytes) -> None:
        """Extract the features of an image (H, W) after those begun before."""
        if self._is_open:
            self._begun.append((grey, self._thread.submit(self._extracted, grey)))

    def take(self, grey: Bytes) -> Features | None:
        """Features of an image, as the extractor would give now; it goes on after them.

        None where they have not been extracted.
        """
        if not self._begun:
            return None
        begun, extracted = self._begun.popleft()
        before, features, after = extracted.result()
        if begun is not grey or before != self._extractor.state:
            self.close()
            return None
        self._extractor.state = after
        return features

    def close(self) -> None:
        """Stop; what has begun is dropped."""
        self._is_open = False
        self._begun.clear()
        self._thread.shutdown(cancel_futures=True)

    def _extracted(self, grey: Bytes) -> _Extracted:
        before = self._own.state
        features = self._own.extract(strengthened(grey).corners)
        return before, features, self._own.state


_Extracted = tuple[tuple[int, float], Features, tuple[int, float]]
"""Features, with the state of the extractor before and after."""
