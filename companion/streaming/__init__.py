"""Streaming of a flight to viewers over thin links.

Knows neither Rerun nor the stages. On board `scene_encoder` turns messages into items, `item_store`
holds the newest of each, and a `session` per viewer schedules them on its link; on the ground
`ground_link` receives the items.
"""
