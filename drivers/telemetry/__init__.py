"""The autopilot's telemetry as samples: readers of logs, and of live messages."""
