"""The computer itself: load, serial ports, systemd, journal, status socket, metrics, Zenoh."""
