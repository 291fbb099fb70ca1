"""Recording of a flight: an MCAP file that survives any end of its writer."""
