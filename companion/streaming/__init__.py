"""The flight as it is shown: what there is to see, and how it gets over a link to who looks on.

Knows neither Rerun nor the stages. On board `encoder` turns messages into items, `store` holds the
newest of each, and a `session` for each viewer chooses what its link is given next; on the ground
`ground_link` gives the items back.
"""
