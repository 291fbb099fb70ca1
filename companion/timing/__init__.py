"""Clocks and their alignment: boot time to flight time, of logs, live links and videos."""
