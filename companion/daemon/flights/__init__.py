"""Live flights: processes, date, recording, results."""
