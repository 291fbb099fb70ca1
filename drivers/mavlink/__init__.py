"""MAVLink to the autopilot and the ground: link, requests, parameters, commands, messages out."""
