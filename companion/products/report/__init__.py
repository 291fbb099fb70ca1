"""The report of a flight, the comparison of two runs, the page of a batch, and their pictures."""
