"""Place recognition, relocalisation, loop closure and the merging of maps."""
