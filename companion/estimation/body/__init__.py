"""The filter of the body's motion: its state, how that changes, and what corrects it."""
