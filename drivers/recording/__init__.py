"""The recording of a flight: an MCAP file that survives whatever ends its writer."""
