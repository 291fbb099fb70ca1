"""Telemetry of the autopilot as samples: readers of logs, and of live messages."""
