"""Place recognition, relocalisation, loop closure and map merging."""
