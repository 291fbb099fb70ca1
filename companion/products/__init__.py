"""What a run leaves behind: trajectory, cloud and report."""
