"""From views of a board to a lens: which views, which model, how good. Pure; no I/O, no clock."""
