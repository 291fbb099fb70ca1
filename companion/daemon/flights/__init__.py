"""One live flight after another: its processes, its date, its recording, its results."""
