"""The autopilot and the ground over MAVLink: link, requests, parameters, commands, messages out."""
