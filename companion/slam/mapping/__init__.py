"""From a new keyframe to a better map: points, bundle adjustment, culling, the atlas of maps."""
