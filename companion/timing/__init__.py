"""Clock synchronisation: boot time to flight time, of logs, live links and videos."""
