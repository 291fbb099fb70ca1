"""MAVLink bytes: carriers (serial, UDP, TCP, MAVSDK), packets, signing, queues, router."""
