"""Results of a run: trajectory, cloud, report, exports."""
