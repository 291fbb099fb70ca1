"""Keyframe insertion: triangulation, bundle adjustment, culling; the atlas of all maps."""
