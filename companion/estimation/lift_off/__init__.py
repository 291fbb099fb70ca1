"""From a stand on the ground up to a metric map: standing still, optical flow, what they aid."""
